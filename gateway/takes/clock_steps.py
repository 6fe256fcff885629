"""Steps of the recording computer's clock within a take: somebody, or NTP, has set it."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from gateway.takes.component_rows import Array

MAX_LISTED_STEPS: Final = 100
"""How many steps are listed; all are counted."""

_WINDOW_US: Final = 1_000_000
_MIN_STEP_US: Final = 500_000
"""Smaller steps look like frames that arrived late."""

_MAX_DEVIATION_US: Final = 100_000
_CONFIRMING_WINDOWS: Final = 5
"""A step counts if the clock stays there for this many windows: after a stall, a network catches up."""

_MAX_PAUSE_WINDOWS: Final = 60


@dataclass(frozen=True, slots=True)
class ClockStep:
    """The clock was set by ``step_us``; ``utime`` is its time after that."""

    utime: int
    step_us: int


class ClockSteps:
    """Finds steps by comparing the times of arrival with the server's time stamps.

    In each second, the frame that arrived earliest counts, as others may have been delayed.
    """

    def __init__(self) -> None:
        self.num_steps = 0
        self.steps: list[ClockStep] = []
        """The first steps, at most MAX_LISTED_STEPS."""
        self._window: tuple[int, int, int] | None = None  # number, least offset, utime
        self._previous = 0  # the number of the last complete window
        self._offset_us: int | None = None  # in the windows so far
        self._pending: list[tuple[int, int]] = []  # offset and utime of windows after a possible step

    def add(self, utime: Array, timestamp_us: Array) -> None:
        """Take the times of arrival and the server's time stamps of the next frames, in µs."""
        if not len(utime):
            return
        offsets = utime - timestamp_us
        numbers = timestamp_us // _WINDOW_US
        (changes,) = np.nonzero(np.diff(numbers))
        starts = np.concatenate([[0], changes + 1])
        least = np.minimum.reduceat(offsets, starts)
        for number, offset, first in zip(
            numbers[starts].tolist(), least.tolist(), utime[starts].tolist(), strict=True
        ):
            if self._window is not None and self._window[0] == number:
                offset = min(offset, self._window[1])  # noqa: PLW2901 - the window continues
                first = self._window[2]  # noqa: PLW2901
            elif self._window is not None:
                self._end_window(*self._window)
            self._window = number, offset, first

    def _end_window(self, number: int, offset: int, utime: int) -> None:
        is_continued = 0 < number - self._previous <= _MAX_PAUSE_WINDOWS
        self._previous = number
        before = self._offset_us
        if before is None or not is_continued or abs(offset - before) < _MIN_STEP_US:
            self._offset_us = offset
            self._pending.clear()
        else:
            if self._pending and abs(offset - self._pending[-1][0]) > _MAX_DEVIATION_US:
                self._pending.clear()
            self._pending.append((offset, utime))
            if len(self._pending) >= _CONFIRMING_WINDOWS:
                self._confirm(*self._pending[0], before)

    def _confirm(self, offset: int, utime: int, before: int) -> None:
        self.num_steps += 1
        if len(self.steps) < MAX_LISTED_STEPS:
            self.steps.append(ClockStep(utime, offset - before))
        self._offset_us = offset
        self._pending.clear()
