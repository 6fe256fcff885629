"""Converting takes to the files of other programs: C3D, OpenSim's, MCAP, CSV.

``job`` lists the formats by extension, says which part of which take becomes which file, creates the files,
and collects what has to be reported. C3D and OpenSim's files have one rate, so ``measurements``
divides a take into parts with one rate and one set of labels, and puts their frames on a grid of the server's
time stamps; CSV and MCAP keep the time of capture of each frame.

- ``c3d``: the groups of a C3D file, its events and its bytes; ``c3d_content`` has points and channels.
- ``opensim``: ground reactions, analog channels and all files for OpenSim; ``trc`` its markers, ``axes`` its
  axes, ``opensim_text`` rows of numbers as text.
- ``plates``: which channels or forces of a plate C3D and OpenSim get.
- ``mcap``: Foxglove's types, made by ``gateway.foxglove_schemas`` as for live viewers.
- ``csv_files``: CSV.

Files appear under their names when they are complete, and never replace others.
"""
