"""The output rtc3d: the gateway as an RT server for the clients of its sources."""
