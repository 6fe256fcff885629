"""The schedule of a replay on the monotonic clock, and how late its messages are."""

import math
import time
from collections.abc import Callable
from typing import Final

_BINS_PER_E: Final = 50
"""Bins of the lateness differ by 2 %."""

_NUM_BINS: Final = 1400
"""The last bin begins at e^28 µs, which is 16 days."""


class Pace:
    """When each position of a take is due: on an absolute schedule, so that no error adds up.

    ``rate`` is how many times as fast as recorded. ``monotonic`` returns the time in s.
    """

    def __init__(self, rate: float, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._s_per_us = 1e-6 / rate
        self._monotonic = monotonic
        self._start_s = 0.0  # when position 0 is due

    def start(self, position_us: int) -> None:
        """Let ``position_us`` be due now, and later ones after it."""
        self._start_s = self._monotonic() - position_us * self._s_per_us

    def change(self, rate: float, position_us: int) -> None:
        """Continue at another rate, with ``position_us`` due now."""
        self._s_per_us = 1e-6 / rate
        self.start(position_us)

    def shift(self, delay_s: float) -> None:
        """Let everything be due later."""
        self._start_s += delay_s

    def due_s(self, position_us: int) -> float:
        """Return when a position is due, on the monotonic clock."""
        return self._start_s + position_us * self._s_per_us


class Lateness:
    """How late messages were: a histogram of fixed size with bins of 2 %."""

    def __init__(self) -> None:
        self.num_messages = 0
        self.max_s = 0.0
        self._counts = [0] * _NUM_BINS

    def add(self, late_s: float) -> None:
        """Count a message."""
        self.num_messages += 1
        self.max_s = max(self.max_s, late_s)
        late_us = late_s * 1e6
        index = int(_BINS_PER_E * math.log(late_us)) + 1 if late_us > 1 else 0
        self._counts[min(index, _NUM_BINS - 1)] += 1

    def quantile_s(self, fraction: float) -> float:
        """Return the lateness that this part of the messages does not exceed, within 2 %; 0.0 without any."""
        rest = fraction * self.num_messages
        for index, count in enumerate(self._counts):
            rest -= count
            if count and rest <= 0:
                return min(math.exp(index / _BINS_PER_E) * 1e-6, self.max_s)
        return self.max_s
