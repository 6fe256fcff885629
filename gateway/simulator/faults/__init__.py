"""The faults of the simulator: their kinds, and the code that begins, applies and ends them.

``base`` says what a fault is: lasting or momentary, for all connections or one, with parameters of its own.
The kinds are in ``packet_faults`` and ``connection_faults``; ``control`` has them by name, and begins and
ends them at once or at the times in a scenario. ``pipeline`` stands between the server and the socket of a
connection: it passes what is sent through the active faults, and holds what is to be late.
"""
