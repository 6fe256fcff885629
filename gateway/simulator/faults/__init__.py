"""What goes wrong with the simulator on purpose: the kinds of faults, and what begins and ends them."""
