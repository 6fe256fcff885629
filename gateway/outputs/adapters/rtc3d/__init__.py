"""The output rtc3d: the gateway as an RT server for its sources' clients, with the frames bit for bit.

The server is ``gateway.session.server``, the same as the simulator's; the scene is a source that streams now.
Start with ``output``: one port for each source, served in a thread with an event loop of its own.

The path of a frame: ``output`` offers it to the thread; ``arrivals`` notes it, with the rate of its stream;
``live_frames`` makes the frames of each choice of components, and ``stream_join`` joins those that arrive on
different connections, by time stamp; ``LiveScene`` in ``live_server`` gives the server the frames that each
client has requested.

- ``live_server``: one source's server: opened, paused while the source does not stream, closed.
- ``client_filter``: what the gateway adds to a client's connection: limits, the control of recordings, and
  C3D files.
"""
