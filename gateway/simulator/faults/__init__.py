"""The faults of the simulator: their kinds, and the code that begins, applies and ends them."""
