"""The doctor: checks every layer between a server and the subscribers, and says how to repair faults."""
