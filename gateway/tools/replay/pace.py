"""When each message of a replay is due, and how late messages were."""

import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Final

STALL_S: Final = 1.0
"""A process that was stopped for longer does not catch up: the rest of the take is played later."""


class PlayerClock:
    """The time of a player; tests replace it."""

    def now_s(self) -> float:
        """Return the time on the monotonic clock."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Let the thread sleep."""
        time.sleep(seconds)

    def wait(self, changed: threading.Condition, seconds: float | None) -> None:
        """Wait until ``changed`` is notified, or for so long."""
        changed.wait(seconds)


class Pace:
    """When each position of a take is due: on an absolute schedule, so that no error adds up.

    ``rate`` is how many times as fast as recorded. ``monotonic`` returns the time in s. If the process stands
    still for longer than STALL_S, everything that follows is due later.
    """

    def __init__(self, rate: float, monotonic: Callable[[], float] = time.monotonic) -> None:
        self.lateness = Lateness()
        self.stalled_s = 0.0
        """For how long the process was stopped, or a disk or an output did not return."""
        self._s_per_us = 1e-6 / rate
        self._monotonic = monotonic
        self._start_s = 0.0  # when position 0 is due
        self._begun_s = 0.0  # when the present wait, or the present message, was to begin

    def start(self, position_us: int) -> None:
        """Let ``position_us`` be due now, and later ones after it."""
        self._begun_s = self._monotonic()
        self._start_s = self._begun_s - position_us * self._s_per_us

    def change(self, rate: float, position_us: int) -> None:
        """Continue at another rate, with ``position_us`` due now."""
        self._s_per_us = 1e-6 / rate
        self._start_s = self._monotonic() - position_us * self._s_per_us

    def shift(self, delay_s: float) -> None:
        """Let everything be due later, after a pause of this length."""
        self._start_s += delay_s
        self._begun_s += delay_s

    def due_s(self, position_us: int) -> float:
        """Return when a position is due, on the monotonic clock."""
        return self._start_s + position_us * self._s_per_us

    def remaining_s(self, position_us: int) -> float:
        """Return how long to wait until a position is due; negative if it is late."""
        now_s = self._monotonic()
        stalled_s = now_s - self._begun_s
        if stalled_s > STALL_S:
            self.shift(stalled_s)
            self.stalled_s += stalled_s
        self._begun_s = now_s
        return self.due_s(position_us) - now_s

    def waited(self, position_us: int) -> None:
        """Take note of the end of a wait for a position: the time until it was due is no stall."""
        self._begun_s = max(self._begun_s, min(self.due_s(position_us), self._monotonic()))


_BINS_PER_E: Final = 50
"""Bins of the lateness differ by 2 %."""


class Lateness:
    """How late messages were: a histogram with bins of 2 %."""

    def __init__(self) -> None:
        self.num_messages = 0
        self.max_s = 0.0
        self._counts: Counter[int] = Counter()  # by bin

    def add(self, late_s: float) -> None:
        """Count a message."""
        self.num_messages += 1
        self.max_s = max(self.max_s, late_s)
        late_us = late_s * 1e6
        self._counts[int(_BINS_PER_E * math.log(late_us)) + 1 if late_us > 1 else 0] += 1

    def quantile_s(self, fraction: float) -> float:
        """Return the lateness that this part of the messages does not exceed, within 2 %; 0.0 without any."""
        rest = fraction * self.num_messages
        for index, count in sorted(self._counts.items()):
            rest -= count
            if rest <= 0:
                return min(math.exp(index / _BINS_PER_E) * 1e-6, self.max_s)
        return self.max_s
