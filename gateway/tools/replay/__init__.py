"""Replaying a take: its messages on Zenoh and LCM under a prefix of their own, at their pace."""
