"""Terminals: keys without Enter, and drawing on the whole screen."""
