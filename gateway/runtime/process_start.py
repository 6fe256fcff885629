"""Settings of Python's interpreter: for a start that imports, and for the event loop that runs after it."""

import gc
import sys
from typing import Final

_SWITCH_INTERVAL_S: Final = 0.0005
"""How long a thread that runs Python keeps another one, such as the event loop, waiting for its lock. Every
message to an output releases that lock once, so that the default of 5 ms would add up to more than the time
between two frames."""

_COLLECT_AFTER_OBJECTS: Final = 700
"""How many objects are made between two garbage collections; few, so that each is short."""


def keep_event_loop_responsive() -> None:
    """Shorten what stops the event loop. Call this before it runs, once most modules are imported.

    The objects of all modules stay until the end. Without ``freeze``, each full garbage collection looks
    through them and stops the event loop for some 20 ms; many tiny packets cause one every second.
    """
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    gc.freeze()
    gc.set_threshold(_COLLECT_AFTER_OBJECTS)
