"""A library for RT servers: serves any scene to any number of clients, at the rates of §5.3.5."""
