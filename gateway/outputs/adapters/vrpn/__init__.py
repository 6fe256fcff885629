"""The output vrpn: a VRPN server with a tracker for each tool."""
