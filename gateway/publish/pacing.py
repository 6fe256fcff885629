"""Limiting the rate of one output: frames are left out evenly, by the server's time."""

import math
from typing import Final

_EARLY_AFTER_EARLY: Final = 0.75
_EARLY_AFTER_LATE: Final = 0.25
"""How early a frame may be, as a share of the frames' spacing; ``due`` explains why there are two values."""


class Pacer:
    """Picks the frames of one component that one output gets: ``max_rate_hz`` (> 0) of them per second.

    Of frames at s Hz it picks those nearest to the multiples of 1/r, where r is ``max_rate_hz`` and below s.
    In the long run the rate is exactly r, and every gap is floor(s/r) or ceil(s/r) frames long. If s is
    below r, it picks all frames. After a pause it restarts with the next frame; it does not catch up.
    """

    def __init__(self, max_rate_hz: float) -> None:
        self._period_us = 1e6 / max_rate_hz
        self._until_next_us = 0.0
        self._was_late = False
        self._timestamp_us: int | None = None
        self._arrival_utime: int | None = None
        # The two intervals before this one; initially such that any interval is the median.
        self._intervals_us: tuple[float, float] = (0, math.inf)

    def due(self, timestamp_us: int | None, arrival_utime: int) -> bool:
        """Return whether to publish this frame. Call it for every frame, in the order of arrival.

        ``timestamp_us`` is the server's time stamp: the picked frames are evenly spaced in the measurement,
        however they arrived. It is None if the server has no usable clock (ServerClock.has_clock). Then, and
        if the time stamp does not grow, ``arrival_utime`` (µs) gives the interval instead.
        """
        if self._arrival_utime is None:
            self._timestamp_us, self._arrival_utime = timestamp_us, arrival_utime
            self._until_next_us = self._period_us
            return True
        if timestamp_us is None or self._timestamp_us is None or timestamp_us <= self._timestamp_us:
            interval_us = max(arrival_utime - self._arrival_utime, 0)
        else:
            interval_us = timestamp_us - self._timestamp_us
        self._timestamp_us, self._arrival_utime = timestamp_us, arrival_utime
        # The median of three: a lost frame, a duplicate or a pause does not change the spacing.
        _, spacing_us, _ = sorted((interval_us, *self._intervals_us))
        self._intervals_us = interval_us, self._intervals_us[0]

        # A frame half-way between two multiples is near to both, and the least jitter would alternate between
        # gaps that are too short and too long. So early frames may stay early, and late ones late.
        self._until_next_us -= interval_us
        if self._until_next_us > spacing_us * (_EARLY_AFTER_LATE if self._was_late else _EARLY_AFTER_EARLY):
            return False
        self._was_late = self._until_next_us < 0
        self._until_next_us += self._period_us
        if self._until_next_us <= 0:
            self._until_next_us = self._period_us
        return True
