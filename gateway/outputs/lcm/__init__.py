"""The LCM output."""
