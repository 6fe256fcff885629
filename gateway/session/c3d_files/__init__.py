"""The C3D files that servers send: received in pieces, written by threads, kept in a folder."""
