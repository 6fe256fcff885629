"""The reverse path: remote peers ask about a source, on Zenoh and on LCM."""
