"""Processes that run a module of this package."""

import os
import sys


def module_environment() -> dict[str, str]:
    """Return the environment for a process that is to find the same modules as this one.

    Python would look for them in the working directory first, where somebody may have a pylsl.py.
    """
    return {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "PYTHONSAFEPATH": "1"}
