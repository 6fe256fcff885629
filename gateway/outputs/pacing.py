"""Limiting the rate of one output by leaving out frames at even intervals of the server's time."""

import math
from typing import Final

_EARLY_AFTER_EARLY: Final = 0.75
_EARLY_AFTER_LATE: Final = 0.25
"""How early a picked frame may be, as a share of the frames' spacing; ``due`` explains the two values."""


class Pacer:
    """Picks the frames of one component to publish on one output: ``max_rate_hz`` (> 0) of them per second.

    Let frames arrive at s Hz, and let r be ``max_rate_hz``. If r is below s, the pacer picks the frames
    nearest to the multiples of 1/r: in the long run the rate is exactly r, and picked frames are floor(s/r)
    or ceil(s/r) frames apart. Otherwise it picks all frames. After a pause it restarts with the next frame
    and does not catch up.
    """

    def __init__(self, max_rate_hz: float) -> None:
        self._period_us = 1e6 / max_rate_hz
        self._until_next_us = 0.0
        self._picked_late = False  # whether the last picked frame followed its multiple of 1/r
        self._timestamp_us: int | None = None
        self._arrival_utime: int | None = None
        # The two previous intervals. With these initial values, any next interval is the median.
        self._intervals_us: tuple[float, float] = (0, math.inf)

    def due(self, timestamp_us: int | None, arrival_utime: int) -> bool:
        """Return whether to publish this frame. Call it for every frame, in the order of arrival.

        ``timestamp_us`` is the server's time stamp, so the picked frames are evenly spaced in the
        measurement, however they arrived. It is None if the server has no usable clock
        (ServerClock.has_clock). Then, and if the time stamp does not increase, ``arrival_utime`` (µs)
        determines the interval.
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

        # Hysteresis: a frame half-way between two multiples is equally near to both, so with a fixed limit
        # the least jitter would make the gaps alternate between too short and too long. After an early frame
        # the next may be early again; after a late one the next should be late again.
        self._until_next_us -= interval_us
        early_share = _EARLY_AFTER_LATE if self._picked_late else _EARLY_AFTER_EARLY
        if self._until_next_us > spacing_us * early_share:
            return False
        self._picked_late = self._until_next_us < 0
        self._until_next_us += self._period_us
        if self._until_next_us <= 0:
            self._until_next_us = self._period_us
        return True
