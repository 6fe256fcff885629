"""The Zenoh output."""
