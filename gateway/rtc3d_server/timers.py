"""A timer that is never early."""

import asyncio
import math
from collections.abc import Callable


def call_after_us(delay_us: float, callback: Callable[[], object]) -> asyncio.TimerHandle:
    """Call ``callback`` after ``delay_us``, rounded up to whole milliseconds; at once if not positive.

    uvloop's timers count whole milliseconds. Without rounding up, a timer could fire just before its
    time, find nothing due and be set again, many times over.
    """
    delay_ms = max(0, math.ceil(delay_us / 1000))
    return asyncio.get_running_loop().call_later(delay_ms / 1000, callback)
