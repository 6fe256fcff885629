"""Converting takes to the files of other programs: C3D, MCAP, CSV, TRC, BIDS.

``job`` lists the formats by extension, says which part of which take becomes which file, creates the files,
and collects what has to be reported. C3D, TRC and BIDS have no times per frame, so ``measurements`` divides a
take into parts with one rate and one set of labels, and puts their frames on a grid of the server's time
stamps; CSV and MCAP keep the time of capture of each frame.

- ``c3d``: the groups of a C3D file, its events and its bytes; ``c3d_content`` has points, channels and force
  plates.
- ``bids``: the files of recordings in a BIDS data set; ``bids_data_set`` has its folders and tables, and
  ``number_text`` its numbers.
- ``mcap``: Foxglove's types, made by ``gateway.foxglove_schemas`` as for live viewers.
- ``text_files``: CSV and TRC.

Files appear under their names when they are complete, and replace no others but tables of BIDS.
"""
