"""Receiving what gateways publish on Zenoh or LCM, sorted by source and key."""
