"""The output that records takes: started, stopped and saved by peers, and kept in a folder.

Start with ``output`` and ``takes``: what peers ask for (``control``) or the server does (``follow``) begins
and ends a take here. Every request to the disk has an owner that ends or undoes it, however long the disk
takes.

The path of a message: ``publisher`` queues it for the thread that writes (``takes.files.writer_thread``);
``take_file`` is a file of a source, with the count of what it lacks.

- ``source_recording``: what is recorded of one source: its running take, and the last seconds.
- ``segments``: these last seconds on the disk, in rolling files. Saving links them, and costs no time.
- ``folder``: the takes that are there, and reading them. ``folder_limits``: how much the folder may hold and
  how old takes may become; the oldest are deleted.
- ``disk``: whether the disk accepts what is written. ``checks``: what the doctor checks.

The format of the files, and everything that reads them, is in ``gateway.takes``.
"""
