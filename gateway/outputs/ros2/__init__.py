"""The output for ROS 2: it speaks the wire format of rmw_zenoh, and needs no ROS installation."""
