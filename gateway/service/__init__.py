"""The daemon: signals, reload, systemd, log formats."""
