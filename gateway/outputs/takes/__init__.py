"""The output that records takes: started, stopped and saved by peers, and kept in a folder.

Start with ``source_takes``: the states of a take, from its start or its save to its end. ``output`` has the
sources, ``control`` what peers ask for (they can delete nothing: only ``disk`` does), ``follow`` what the
server does. Every request to the disk has an owner that ends or undoes it, however long the disk takes.

The path of a message: ``publisher`` queues it for the thread that writes (``takes.files.writer_thread``);
``take_file`` is a file of a source, with the count of what it lacks.

- ``segments``: the last seconds on the disk, in rolling files. Saving links them, and costs no time.
- ``folder``: the takes that are there, and reading them.
- ``disk``: what all sources share. Whether the disk accepts what is written; how much the folder may hold and
  how old takes may become (the oldest are deleted); the threads. ``checks``: what the doctor checks.

The format of the files, and everything that reads them, is in ``gateway.takes``.
"""
