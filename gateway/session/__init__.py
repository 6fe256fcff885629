"""RTC3D over TCP. Here: from an RT server to frames, the sessions of one source.

``server`` is the other side, an RT server for any scene. ``c3d_files`` are the files that servers send.

A source has one stream for each connection to its server. A server never sends faster than the slowest
component that a connection requests (§5.3.5), so components with different rates need different connections.

The path of a frame, as calls without a task between them: ``session`` reads bytes and gives them to
``rtc3d.client_protocol``, which returns frames. ``backlog`` passes a few frames on at once, and many that
arrived together at a pace. ``ingest`` computes when each frame was captured (``clock``), counts the frames
that the server left out (``missing_frames``), skips late ones if the configuration says so, and calls
``publish.fan_out``, whose routes call the publishers of the outputs.

Around it, from the outside to the inside:

- ``streams``: which streams a source has, as configured or as ``plan`` derives them from the server's
  parameters. ``plan`` also decides when frames are so late that a lower rate is requested.
- ``supervisor``: one stream, kept running. It opens a connection (``tcp``), runs a session, waits
  (``Backoff``) and tries again.
- ``session``: one TCP connection, used once. It reads when other sources had their turn and no ``backlog``
  waits.
- ``stream_requests``: what a session asks the server for, handshake and signs of life included, and what the
  server should send now: at which rate (halved as ``plan`` decides, with ``adapt_rate``), or nothing.
  ``replies`` has the commands that wait for a reply; ``rate_check`` compares the rate that arrives with the
  one that was requested.
- ``status``: what is known about a stream, its counters and its failures. ``state`` derives one word from it.

Time-outs count only the time during which this process runs (``process_clock``). Nothing here knows any
output.
"""
