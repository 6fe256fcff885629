"""LCM messages made from RTC3D components, their topics, and decoding them for people.

``publish.fan_out`` gives messages their numbers; ``sequence_check`` here finds gaps in those received.
``descriptions`` is what the server's parameters say about the items in them. ``ros2`` and ``foxglove`` have
the messages that others understand.
"""
