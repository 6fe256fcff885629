"""Converting takes to the files of other programs: C3D, MCAP, CSV, TRC."""
