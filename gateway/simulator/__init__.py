"""The simulator: an RT server with synthetic or recorded scenes, and with faults on request."""
