"""The running gateway: its sources and outputs, its health, and the daemon around them.

- ``daemon``: what systemd starts: signals, reloads of the configuration, notifications.
- ``gateway``: all sources and outputs of one configuration; it builds, connects, reloads and stops them.
- ``source``: the supervisors of its streams, its fan-out to the outputs, and the queries about it.
- ``monitoring``: metrics, the health check, the limits of the process; it reads the counters of the others.
"""
