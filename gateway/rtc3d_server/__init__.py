"""An RT server for any scene: clients, commands, the rate rules of §5.3.5."""
