"""The files of takes: event logs, written by a thread, read, described, and decoded into arrays."""
