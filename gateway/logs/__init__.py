"""Logging: failures, losses and repeated events, the formats of the log, and text that is safe in it."""
