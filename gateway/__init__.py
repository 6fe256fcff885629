"""The RTC3D gateway: from motion-capture servers (NDI First Principles, WaveFront) to Zenoh and LCM."""

__version__ = "0.1.0"
