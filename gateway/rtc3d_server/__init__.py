"""A library for RT servers: serves any scene to any number of clients, by the rate rules of §5.3.5."""
