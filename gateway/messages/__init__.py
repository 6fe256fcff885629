"""LCM messages made from RTC3D components, their topics, and decoding them for people."""
