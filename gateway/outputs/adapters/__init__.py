"""Outputs for programs that speak neither Zenoh nor LCM with this gateway's messages.

Each uses only the contract of outputs, and could be a package of its own. ``ros2`` also uses the Zenoh
session of ``outputs.zenoh``, because ROS 2 speaks Zenoh, too.
"""
