"""The messages that the gateway publishes, and what can be read from them.

- ``encode`` makes LCM messages of RTC3D components; ``decode`` reads them, also as JSON. ``topics`` has their
  keys on Zenoh and channels on LCM. ``publish.fan_out`` gives them their numbers.
- ``coordinate_frame`` turns poses into metres, with quaternions in the order x, y, z, w.
- ``history`` keeps the newest messages of a source; ``sequence_check`` finds gaps in what was received.
- ``source_report`` is what a status says, for all displays; ``summary`` is a message in one line. ``texts``
  moves values into the range of a field, and ``transliteration`` into ASCII. ``take_names`` has the names of
  takes, ``host_time`` the clocks.
- ``descriptions``: what the server's parameters say about the items: labels, units, force plates.
- ``ros2`` and ``foxglove``: the messages of those.
"""
