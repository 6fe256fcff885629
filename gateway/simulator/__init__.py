"""Scenes and faults for an RT server that stands in for the hardware."""
