"""What interrupts a take: lost messages, a new start of numbers and times, steps of the clock."""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from gateway.takes.files.component_rows import Array

MAX_LATE: Final = 1000
"""If a sequence number goes back by more, it starts again; by less, another message may have overtaken it."""

_NO_TIMES_US: Final = np.array([0, -1, -(1 << 63)], np.int64)
"""What servers send if they have no time (field note 25)."""

_MAX_STEP: Final = 10
_MAX_STEP_US: Final = 1_000_000
"""Two messages with at most one between them fit each other if they are not further apart than this."""

_WRAP: Final = 1 << 32
_WRAP_TOLERANCE_US: Final = 10_000_000
"""32-bit time stamps start again at 0; a time stamp that goes back by about this much has wrapped around."""


class Restarts(NamedTuple):
    """For each row but the first, whether something starts again there; bool, shape (rows − 1,).

    ``sequence``: the gateway started again, or the rows belong to another take. ``server``: the server's time
    stamps or frame numbers start again, with a new measurement or a new start of the server.
    """

    sequence: Array
    server: Array


def find_restarts(utime: Array, sequence: Array, timestamp_us: Array, frame_number: Array) -> Restarts:
    """Return where rows, in the order of arrival, start again. The arrays are native integers.

    A message that was overtaken by others on the network is no restart, and neither is one message with
    damaged numbers.
    """
    step = np.diff(sequence)
    is_restart = (step < -MAX_LATE) | ((step <= 0) & (np.diff(utime) > 0))
    is_late = (step <= 0) & ~is_restart
    is_server = _time_goes_back(timestamp_us)
    frame_step = np.diff(frame_number.astype(np.int64))
    is_server |= (frame_step < 0) & (frame_step > -(_WRAP // 2))
    is_intact = ~_is_beside_damage(sequence, timestamp_us, frame_number)
    return Restarts(is_restart & is_intact, is_server & ~is_late & is_intact)


def _is_beside_damage(sequence: Array, timestamp_us: Array, frame_number: Array) -> Array:
    """Return for each step whether the row before it, or after it, lies between two that fit each other."""
    beside = np.zeros(max(len(sequence) - 1, 0), bool)
    step, time_step = sequence[2:] - sequence[:-2], timestamp_us[2:] - timestamp_us[:-2]
    regular_steps = np.diff(timestamp_us)
    regular_steps = regular_steps[(regular_steps > 0) & (regular_steps <= _MAX_STEP_US)]
    if not len(regular_steps):
        return beside
    fits = (frame_number[2:] >= frame_number[:-2]) & (step > 0) & (step <= _MAX_STEP)
    fits &= (time_step >= 1.5 * np.median(regular_steps)) & (time_step <= _MAX_STEP_US)
    beside[:-1] |= fits
    beside[1:] |= fits
    return beside


def _time_goes_back(timestamp_us: Array) -> Array:
    """Return where time stamps are less than the newest one before; those without a time do not count."""
    goes_back = np.zeros(max(len(timestamp_us) - 1, 0), bool)
    (places,) = np.nonzero(~np.isin(timestamp_us, _NO_TIMES_US))
    step = np.diff(timestamp_us[places])
    is_wrap = np.abs(step + _WRAP) < _WRAP_TOLERANCE_US
    # If rows without a time are between both, the first of them belongs to what follows: it may begin at 0.
    goes_back[places[:-1][(step < 0) & ~is_wrap]] = True
    return goes_back


MAX_LISTED_GAPS: Final = 100
"""How many gaps are listed; all are counted."""

_MAX_GAP: Final = 1_000_000
"""A number that jumps by more may be damaged. The next message shows whether it is."""

_MAX_EXPECTED: Final = 10_000
"""How many missing numbers may still arrive late."""


@dataclass(slots=True)
class Gap:
    """``missing`` messages in a row, before the message that arrived at ``utime``."""

    utime: int
    missing: int


class SequenceGaps:
    """Finds the gaps in the numbers of one key. Messages may arrive late or twice, as on LCM."""

    def __init__(self) -> None:
        self.missing = 0
        """How many messages are missing."""
        self.late = 0
        """How many messages arrived after later ones; they are not missing."""
        self.repeated = 0
        """How many messages arrived again."""
        self.restarts = 0
        """How often the numbers started again: the gateway did, or another recording follows."""
        self.implausible = 0
        """How many messages have numbers that fit neither what comes before nor after: they are damaged."""
        self.num_gaps = 0
        self._listed: list[Gap] = []
        self._largest: Gap | None = None
        self._newest: tuple[int, int] | None = None  # sequence and utime
        self._doubtful: tuple[int, int] | None = None  # after _newest: either damaged, or a new beginning
        self._expected: OrderedDict[int, Gap] = OrderedDict()  # missing numbers that may come late

    @property
    def gaps(self) -> list[Gap]:
        """The first gaps, at most MAX_LISTED_GAPS."""
        return [gap for gap in self._listed if gap.missing]

    @property
    def largest(self) -> Gap | None:
        """The largest gap; None if there is none."""
        candidates = self.gaps
        if self._largest is not None and self._largest.missing:
            candidates.append(self._largest)
        return max(candidates, key=lambda gap: gap.missing, default=None)

    def add(self, sequence: Array, utime: Array) -> None:
        """Take the numbers and times (µs) of the next messages, each with shape (messages,)."""
        if not len(sequence):
            return
        first = int(sequence[0])  # numpy's integers overflow
        is_next = self._newest is None or (first - self._newest[0] == 1 and self._doubtful is None)
        if is_next and (np.diff(sequence) == 1).all():
            self._newest = int(sequence[-1]), int(utime[-1])
            return
        for number, time in zip(sequence.tolist(), utime.tolist(), strict=True):
            self._add(number, time)

    def finish(self) -> None:
        """Count what only a further message could have shown to be damaged. Call it at the end."""
        if self._doubtful is not None:
            self._begin_again(*self._doubtful)

    def _add(self, number: int, utime: int) -> None:
        if self._newest is None:
            self._newest = number, utime
            return
        if self._doubtful is not None:
            if _continues(*self._newest, number, utime):
                self.implausible += 1
                self._doubtful = None
            else:
                self._begin_again(*self._doubtful)
        newest, newest_utime = self._newest
        if not _continues(newest, newest_utime, number, utime):
            self._doubtful = number, utime
        elif number <= newest:
            self._add_late(number)
        else:
            if number > newest + 1:
                self._add_gap(newest + 1, number, utime)
            self._newest = number, utime

    def _begin_again(self, number: int, utime: int) -> None:
        """Continue at a number far from the newest one: after a long gap, or because the numbers restart."""
        if self._newest is not None and number > self._newest[0]:
            self._add_gap(self._newest[0] + 1, number, utime)
        else:
            self.restarts += 1
            self._expected.clear()
        self._newest = number, utime
        self._doubtful = None

    def _add_gap(self, first: int, stop: int, utime: int) -> None:
        gap = Gap(utime, stop - first)
        self.num_gaps += 1
        self.missing += gap.missing
        if len(self._listed) < MAX_LISTED_GAPS:
            self._listed.append(gap)
        if self._largest is None or gap.missing > self._largest.missing:
            self._largest = gap
        for number in range(max(first, stop - _MAX_EXPECTED), stop):
            self._expected[number] = gap
        while len(self._expected) > _MAX_EXPECTED:
            self._expected.popitem(last=False)

    def _add_late(self, number: int) -> None:
        gap = self._expected.pop(number, None)
        if gap is None:
            self.repeated += 1
            return
        self.late += 1
        self.missing -= 1
        gap.missing -= 1
        if not gap.missing:
            self.num_gaps -= 1


def _continues(newest: int, newest_utime: int, number: int, utime: int) -> bool:
    """Return whether a message follows the newest one, with a gap or not, or was overtaken by it."""
    if number > newest:
        return number - newest <= _MAX_GAP
    return utime <= newest_utime and newest - number <= MAX_LATE


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
