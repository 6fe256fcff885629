"""The RTC3D protocol, both sides, without I/O."""
