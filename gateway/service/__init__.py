"""The daemon: signals, reload, systemd notifications and logging."""
