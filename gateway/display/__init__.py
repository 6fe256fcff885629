"""What people look at: the 3D view, the tables of ``top``, and the live data that both show."""
