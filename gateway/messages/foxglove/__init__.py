"""Messages with Foxglove's types, for MCAP files and for live subscribers."""
