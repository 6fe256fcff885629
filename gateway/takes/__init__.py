"""Takes: recordings of a gateway's messages as LCM event logs, written and read."""
