"""The output that records takes: started, stopped and saved by peers, and kept in a folder."""
