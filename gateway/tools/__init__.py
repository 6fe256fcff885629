"""What people type and look at: the command line, the view and ``top``, the doctor, and replaying takes."""
