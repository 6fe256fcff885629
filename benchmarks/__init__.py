"""Comparisons of the gateway with bare Zenoh, LCM and TCP: `make bench`, docs/dev/performance.md."""
