"""Messages of ROS 2: their definitions, their names, and their encoding as CDR."""
