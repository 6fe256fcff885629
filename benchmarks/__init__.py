"""What the gateway costs beside bare Zenoh and LCM: `make bench`, docs/performance.md."""
