"""Converting takes to the files of other programs: C3D, OpenSim's, BIDS, MCAP, bags of ROS 2, Parquet, CSV.

``registry`` lists the formats, also those of other packages. ``job`` says which part of which take becomes
which file, creates the files, and collects what has to be reported. C3D, BIDS and OpenSim's files have one
rate, so ``measurements`` divides a take into parts with one rate and one set of labels, and ``grid`` gives
each frame a row by its number and time stamp, which ``row_shifts`` and ``period`` compare.
MCAP, and the tables in CSV and Parquet, keep the time of capture of each frame.

- ``c3d``: the groups of a C3D file, its events and its bytes; ``c3d_content`` has points and channels.
- ``opensim``: ground reactions, analog channels and all files for OpenSim; ``trc`` its markers, ``axes`` its
  axes.
- ``plates``: which channels or forces of a plate C3D and OpenSim get.
- ``bids``: the files of recordings in a BIDS data set; ``bids_data_set`` has its folders and tables.
- ``number_text``: rows of numbers as text, for OpenSim, BIDS and CSV.
- ``rosbag``: the messages of the output ``ros2``.
- ``mcap``: Foxglove's types, made by ``gateway.messages.foxglove`` as for live viewers.
- ``mcap_file``: what ``mcap`` and ``rosbag`` have in common.
- ``tables``: the take as tables, one per component; ``csv_files`` and ``parquet`` write them.

Files appear under their names when they are complete, and replace no others but tables of BIDS.
"""
