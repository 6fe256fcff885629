"""RTC3D, the protocol of NDI First Principles and WaveFront: bytes in, events and bytes out, no I/O."""
