"""Gaps in the sequence numbers of one key: messages that were lost, wherever it happened."""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

import numpy as np

from gateway.takes.component_rows import Array
from gateway.takes.restarts import MAX_LATE

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
