"""How frames are thinned out for one output: evenly, and by the server's time."""

import math
from typing import Final

_FAR: Final = 0.75
_NEAR: Final = 0.25
"""How much of the frames' spacing a frame may be ahead of its time; why there are two is told in ``due``."""


class Pacer:
    """Picks the frames that go out at no more than ``max_rate_hz`` (> 0), for one component and one output.

    Of frames at s Hz, those nearest to the multiples of 1/r go out, where r is ``max_rate_hz`` below s. In
    the long run r is exact, whatever s is, and every gap is of floor(s/r) or ceil(s/r) frames. Where s is
    below r, all go out. After a pause it begins anew with the frame that ends it: nothing is made up for.
    """

    def __init__(self, max_rate_hz: float) -> None:
        self._period_us = 1e6 / max_rate_hz
        self._until_next_us = 0.0
        self._was_late = False
        self._timestamp_us: int | None = None
        self._arrival_utime: int | None = None
        # Before the last frame and the one before that; at first so that any time is the middle one.
        self._passed_us: tuple[float, float] = (0, math.inf)

    def due(self, timestamp_us: int | None, arrival_utime: int) -> bool:
        """Return whether this frame goes out; called for each frame, in the order in which they came.

        ``timestamp_us`` is the server's time stamp: what goes out is evenly spaced in the measurement,
        however it came. It is None where the server has no clock (ServerClock.has_clock). Then, and where
        the stamp stands still or goes back, ``arrival_utime`` (µs) tells how much time has passed instead.
        """
        if self._arrival_utime is None:
            self._timestamp_us, self._arrival_utime = timestamp_us, arrival_utime
            self._until_next_us = self._period_us
            return True
        if timestamp_us is None or self._timestamp_us is None or timestamp_us <= self._timestamp_us:
            passed_us = max(arrival_utime - self._arrival_utime, 0)
        else:
            passed_us = timestamp_us - self._timestamp_us
        self._timestamp_us, self._arrival_utime = timestamp_us, arrival_utime
        # The middle one of three: a lost frame, a doubled one and a pause do not change the spacing.
        _, spacing_us, _ = sorted((passed_us, *self._passed_us))
        self._passed_us = passed_us, self._passed_us[0]

        # A frame half-way between two multiples is near to both, and the least jitter would make gaps too
        # short and too long by turns. So early frames may go on being early, and late ones late.
        self._until_next_us -= passed_us
        if self._until_next_us > spacing_us * (_NEAR if self._was_late else _FAR):
            return False
        self._was_late = self._until_next_us < 0
        self._until_next_us += self._period_us
        if self._until_next_us <= 0:
            self._until_next_us = self._period_us
        return True
