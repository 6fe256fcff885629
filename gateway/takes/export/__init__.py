"""Converting takes to the files of other programs: C3D, MCAP, Parquet, CSV, TRC.

``job`` lists the formats by extension, says which part of which take becomes which file, creates the files,
and collects what has to be reported. C3D and TRC have one rate and no times per frame, so ``measurements``
divides a take into parts with one rate and one set of labels, and puts their frames on a grid of the server's
time stamps; MCAP, and the tables in CSV and Parquet, keep the time of capture of each frame.

- ``c3d``: the groups of a C3D file, its events and its bytes; ``c3d_content`` has points, channels and force
  plates.
- ``mcap``: Foxglove's types, made by ``gateway.foxglove_schemas`` as for live viewers.
- ``tables``: the take as tables, one per component; ``csv_files`` and ``parquet`` write them.
- ``trc``: markers for OpenSim.

Files appear under their names when they are complete, and never replace others.
"""
