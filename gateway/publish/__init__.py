"""From one source to all outputs: numbering, pacing, per-tool poses."""
