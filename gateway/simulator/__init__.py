"""The simulator: an RT server with synthetic or recorded scenes, and with faults on request.

The server itself is ``gateway.session.server``. A scene tells it which frames there are at which time:

- ``synthetic``: computed from the time alone, of the ``bodies`` and force plates that move in it.
- ``c3d_scene``: a C3D file, which a child process with limits reads, because files may be malformed;
  ``c3d_recording`` is what that process does.
- ``take_scene``: a take of this gateway. ``take_playback`` reads it ahead while it plays, in passes
  (``take_pass``). ``take_moments`` decides which components belong to the same frame and when it is due,
  ``take_frames`` makes the frames that a client has requested.

``simulator`` joins a scene, the server and the faults: it begins and ends faults at once, or at the times in
a scenario file. ``faults`` has the kinds that concern the bytes sent (delay, split), the connection (reset)
and the server; ``packet_faults`` has those that change frames and replies. ``fault_pipeline`` stands between
the server and the socket of a connection: it passes what is sent through the active faults, and holds what is
to be late.
"""
