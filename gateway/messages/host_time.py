"""The host's clocks in the unit of the messages: the wall clock, and a steady clock that nobody sets."""

import logging
import time
from collections.abc import Callable
from typing import Final

from gateway.runtime.failures import Repeats

STEP_US: Final = 1_000
"""A change of the wall clock by this much is a step: somebody has set it."""

_TOLERANCE_US: Final = 20
"""Two readings of both clocks may differ by this much although nobody has set the wall clock."""

_READINGS: Final = 5
"""How many readings confirm a change: the process may be interrupted between the two clocks of a reading."""

_LOGGED_STEPS: Final = 10
_LOG_WINDOW_S: Final = 3600.0
"""At most so many steps in this time are logged as WARNING; further ones as DEBUG."""

_STEADY_CLOCK: Final[int] = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)  # only Linux has the first

_time_ns: Final = time.time_ns
_clock_ns: Final = time.clock_gettime_ns
"""Save looking them up: the clocks are read three times per frame."""

logger = logging.getLogger(__name__)


def now_utime() -> int:
    """Return the host's time in µs since the Unix epoch."""
    return time.time_ns() // 1000


def now_steady_us() -> int:
    """Return the time on the host's steady clock in µs since some moment, which nobody can set.

    On Linux it also counts while the host is suspended, so what the server sent then arrives late.
    """
    return time.clock_gettime_ns(_STEADY_CLOCK) // 1000


class HostClock:
    """Reads both clocks together, and detects that somebody has set the wall clock (a step).

    What arrives is dated by the steady clock, plus the offset of the wall clock. So durations do not depend
    on the wall clock, and the time of day follows a step at once.
    """

    def __init__(self) -> None:
        self.offset_us = clock_difference_us(now_utime, now_steady_us)
        """Wall clock minus steady clock, at the newest reading."""
        self.steps = 0
        """How often the wall clock was set since this object was made."""
        self._repeats = Repeats(_LOGGED_STEPS, _LOG_WINDOW_S)

    def read(self) -> tuple[int, int]:
        """Return the time in µs since the Unix epoch and the same moment on the steady clock in µs.

        Their difference is exactly the same in every reading until the wall clock changes.
        """
        utime, steady_us = _time_ns() // 1000, _clock_ns(_STEADY_CLOCK) // 1000
        change_us = utime - steady_us - self.offset_us
        if change_us > _TOLERANCE_US or change_us < -_TOLERANCE_US:
            self._follow(steady_us)
        return steady_us + self.offset_us, steady_us

    def _follow(self, steady_us: int) -> None:
        """Measure the offset again; if the wall clock was set, count and log it."""
        offset_us = clock_difference_us(now_utime, now_steady_us)
        change_us = offset_us - self.offset_us
        if abs(change_us) <= _TOLERANCE_US:  # only the reading was interrupted
            return
        self.offset_us = offset_us
        if abs(change_us) < STEP_US:
            return
        self.steps += 1
        is_hidden = self._repeats.count(steady_us * 1e-6) is None
        direction = "forward" if change_us > 0 else "back"
        logger.log(
            logging.DEBUG if is_hidden else logging.WARNING,
            "the clock of this computer was set %s by %.3f s; utime and capture_utime follow; "
            "rates and lag do not change",
            *(direction, abs(change_us) / 1e6),
        )


def clock_difference_us(clock: Callable[[], int], base: Callable[[], int]) -> int:
    """Return ``clock`` minus ``base``, both in µs, from the reading that was interrupted least."""
    best_us, difference_us = -1, 0
    for _ in range(_READINGS):
        before_us = base()
        time_us = clock()
        duration_us = base() - before_us
        if best_us < 0 or duration_us < best_us:
            best_us, difference_us = duration_us, time_us - before_us
    return difference_us


host_clock: Final = HostClock()
"""The clock of this process."""
