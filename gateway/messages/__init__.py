"""LCM messages made from RTC3D components, their topics, and decoding them for people.

``publish.fan_out`` gives messages their numbers; ``sequence_check`` here finds gaps in those received.
"""
