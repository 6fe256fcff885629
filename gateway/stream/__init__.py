"""From an RT server to frames: the TCP sessions of one source.

A source has one stream for each connection to its server. A server never sends faster than the slowest
component that a connection requests (§5.3.5), so components with different rates need different connections.

The path of a frame: ``session`` reads bytes and gives them to ``rtc3d.client_protocol``, which returns
frames. A few frames at a time go on at once; many that arrived together are a ``backlog`` and go on at a
pace. ``ingest`` computes when each frame was captured (``clock``), counts the frames that the server left
out, skips late ones if the configuration says so, and hands the rest to ``publish.fan_out``.

Around it, from the outside to the inside:

- ``streams``: which streams a source has, as configured or as ``plan`` derives them from the server's
  parameters.
- ``supervisor``: one stream, kept running. It opens a connection (``tcp``), runs a session, waits and tries
  again.
- ``session``: one TCP connection, used once; ``reading`` says when it reads, so that other sources have their
  turn.
- ``stream_requests``: what the session asks the server for: handshake, rate, pause, signs of life.
  ``replies`` has the commands that wait for a reply; ``rate_check`` compares the rate that arrives with the
  one that was requested.
- ``status``: what is known about a stream, its counters and its failures. ``state`` derives one word from it,
  and ``status_text`` makes sentences of it.

Time-outs count only the time during which this process runs (``process_clock``). Nothing
here knows any output.
"""
