"""The simulator: scenes for an RT server that stands in for the hardware, and faults."""
