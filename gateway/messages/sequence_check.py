"""What the sequence numbers of one key or channel show: losses, restarts, and messages in another order.

Subscribers check the messages that they receive, and the statistics of a take those that it has.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

MAX_LATE: Final = 1000
"""A number that is further behind the newest one was not overtaken on the network: the numbers restart."""

_MAX_GAP: Final = 1_000_000
"""A number that is further ahead is doubtful: if the numbers before it go on, the message was damaged."""

_NUM_RECENT: Final = 32
"""How many messages are remembered to recognise copies, and how many gaps to be filled by late messages."""

_NUM_FORMER: Final = 4
"""How many interrupted numberings are remembered: networks reorder few messages, and few gateways collide."""

_MANY_ALTERNATIONS: Final = 10


@dataclass(slots=True)
class Gap:
    """``missing`` messages in a row, before the message that arrived at ``utime``."""

    utime: int
    missing: int
    stop: int
    """The number after those of the gap."""
    late: int = 0
    """A bit for each message that arrived late: 0 for number ``stop - 1``, 1 for the one before."""

    @property
    def first(self) -> int:
        """The first number of the gap: the missing and the late messages are all of it."""
        return self.stop - self.missing - self.late.bit_count()

    def fill(self, number: int) -> bool:
        """Take a late message; return whether it was missing. At most MAX_LATE bits are set."""
        bit = 1 << (self.stop - 1 - number)
        if self.late & bit:
            return False
        self.late |= bit
        self.missing -= 1
        return True


class GapList:
    """The gaps in the numbers of one key: all are counted, and the first ``max_listed`` are listed.

    Late messages fill gaps, and some gaps turn out to be none. So the counts change with each gap, here only.
    """

    def __init__(self, max_listed: int) -> None:
        self.num_lost = 0
        """How many messages are missing."""
        self.num_gaps = 0
        """In how many places they are missing."""
        self._max_listed = max_listed
        self._listed: list[Gap] = []
        self._largest: Gap | None = None

    @property
    def listed(self) -> list[Gap]:
        """The first gaps of which messages are still missing."""
        return [gap for gap in self._listed if gap.missing]

    @property
    def largest(self) -> Gap | None:
        """The largest gap; None if there is none, or none is listed."""
        candidates = self.listed
        if self._largest is not None and self._largest.missing:
            candidates.append(self._largest)
        return max(candidates, key=lambda gap: gap.missing, default=None)

    def add(self, gap: Gap) -> None:
        """Count a new gap."""
        self.num_gaps += 1
        self.num_lost += gap.missing
        if len(self._listed) < self._max_listed:
            self._listed.append(gap)
        if self._max_listed and (self._largest is None or gap.missing > self._largest.missing):
            self._largest = gap

    def fill(self, gap: Gap, number: int) -> bool:
        """Take a late message; return whether it was missing."""
        if not gap.fill(number):
            return False
        self.num_lost -= 1
        self.num_gaps -= not gap.missing
        return True

    def shorten(self, gap: Gap, stop: int) -> None:
        """Let a gap end before number ``stop``: what seemed to be missing from there on was not."""
        num_before = gap.missing
        gap.missing, gap.stop, gap.late = min(num_before, max(0, stop - gap.first)), stop, 0
        self.num_lost -= num_before - gap.missing
        self.num_gaps -= num_before > 0 and not gap.missing

    def remove(self, gap: Gap) -> None:
        """Forget a gap: nothing was missing there."""
        self.num_lost -= gap.missing
        self.num_gaps -= gap.missing > 0
        gap.missing = 0
        self._listed = [each for each in self._listed if each is not gap]


@dataclass(slots=True)
class _Numbering:
    """Numbers that follow each other without a gap."""

    newest: int
    utime: int
    """When the newest message was sent."""
    num_messages: int
    gaps: deque[Gap]
    """The recent gaps that late messages may fill. What follows a gap shares them."""
    gap: Gap | None = None
    is_restart: bool = False
    """What was counted when the numbering was interrupted: it did not happen if the numbering goes on."""


class SequenceCheck:
    """Follows the sequence numbers of one key, and counts what is missing. Messages may arrive late or twice.

    Numbers before the first message are not missing. If the numbers start again, the gateway has restarted.
    Each gap and each restart interrupts a numbering. If that goes on later, nothing was missing there: the
    message between had a damaged number, or two gateways publish on the same key.

    ``max_listed`` is how many gaps are listed; all are counted. ``counts_first``: the messages before the
    first one after a restart are missing, because a subscriber would have received them.
    """

    def __init__(self, *, max_listed: int = 0, counts_first: bool = False) -> None:
        self.num_restarts = 0
        """How often the numbers started again: the gateway did, or another recording follows."""
        self.num_late = 0
        """How many messages arrived after later ones; they are not missing."""
        self.num_repeated = 0
        """How many messages arrived twice."""
        self.num_implausible = 0
        """How many messages have numbers that fit neither what comes before nor after: they are damaged."""
        self.num_alternations = 0
        """How often an interrupted numbering went on."""
        self.session = 0
        """The session of the newest message."""
        self._gaps = GapList(max_listed)
        self._counts_first = counts_first
        self._current: _Numbering | None = None
        self._begins_at: int | None = None  # what is missing from here to the first message is lost
        self._former: deque[_Numbering] = deque(maxlen=_NUM_FORMER)
        self._recent: deque[tuple[int, int]] = deque(maxlen=_NUM_RECENT)  # number and time

    @property
    def has_two_publishers(self) -> bool:
        """Whether two gateways publish, as far as the numbers show. Then losses are not counted exactly."""
        return self.num_alternations >= _MANY_ALTERNATIONS

    @property
    def num_lost(self) -> int:
        """How many messages are missing."""
        return self._gaps.num_lost

    @property
    def num_gaps(self) -> int:
        """In how many places they are missing."""
        return self._gaps.num_gaps

    @property
    def gaps(self) -> list[Gap]:
        """The first gaps, at most ``max_listed``."""
        return self._gaps.listed

    @property
    def largest(self) -> Gap | None:
        """The largest gap; None if there is none, or none is listed."""
        return self._gaps.largest

    def add(self, sequence: int, utime: int, session: int = 0) -> None:
        """Take the next message, by its number, its time, and its session if sessions can show a restart."""
        current = self._current
        if current is None:
            self._begin(sequence, utime)
        elif sequence == current.newest + 1:
            current.newest = sequence
            current.utime = utime
            current.num_messages += 1
        elif (sequence, utime) in self._recent:
            self.num_repeated += 1
            return
        elif not self._fill_gap(current, sequence, utime):
            self._interrupt(current, sequence, utime, session)
        self._recent.append((sequence, utime))
        self.session = session

    def add_all(self, sequences: npt.NDArray[np.int64], utimes: npt.NDArray[np.int64]) -> None:
        """Take the next messages; both arrays have the shape (messages,)."""
        done = 0
        if len(sequences) > _NUM_RECENT and (np.diff(sequences) == 1).all():
            self.add(int(sequences[0]), int(utimes[0]))
            done = 1
            current = self._current
            if current is not None and current.newest == int(sequences[0]):
                # Those that only follow each other are skipped, up to those that copies are compared with.
                done = len(sequences) - _NUM_RECENT
                current.newest = int(sequences[done - 1])
                current.num_messages += done - 1
        for sequence, utime in zip(sequences[done:].tolist(), utimes[done:].tolist(), strict=True):
            self.add(sequence, utime)

    def end(self, stop: int) -> None:
        """Take what follows the newest message, before number ``stop``, as missing: nothing follows it."""
        current = self._current
        if current is None:
            if self._begins_at is not None and stop > self._begins_at:
                self._begin(stop, 0).newest = stop - 1
        elif stop > current.newest + 1:
            self._add_gap(Gap(current.utime, stop - current.newest - 1, stop), current.gaps)
            current.newest = stop - 1

    def begin_at(self, number: int, *, is_restart: bool = False) -> None:
        """Expect a numbering that begins with a number: what is missing from there on is lost.

        The caller knows whether the gateway has restarted; the next numbers do not always show it.
        """
        self.num_restarts += is_restart
        self._current, self._begins_at = None, number
        self._former.clear()

    def _begin(self, sequence: int, utime: int) -> _Numbering:
        self._current = current = _Numbering(sequence, utime, 1, deque(maxlen=_NUM_RECENT))
        if self._begins_at is not None and sequence > self._begins_at:
            self._add_gap(Gap(utime, sequence - self._begins_at, sequence), current.gaps)
        self._begins_at = None
        return current

    def skip(self, stop: int) -> None:
        """Go on before number ``stop``: what is between the newest message and that is not missing."""
        current = self._current
        if current is not None and stop > current.newest + 1:
            current.newest = stop - 1

    def correct(self, number: int) -> None:
        """Take ``number`` as that of the newest message: the one that it had was damaged."""
        self.num_implausible += 1
        if (current := self._current) is None:
            return
        current.newest = number
        # What seemed to be missing up to the false number was not.
        for gap in current.gaps:
            if gap.stop > number:
                self._gaps.shorten(gap, number)

    def _fill_gap(self, current: _Numbering, sequence: int, utime: int) -> bool:
        """Return whether a message was missing, and was only overtaken by others."""
        if not (0 < current.newest - sequence <= MAX_LATE and utime <= current.utime):
            return False
        for gap in current.gaps:
            # A numbering can share a gap with another one, of which it does not reach the end: a damaged
            # number. To fill that would take a bit for each of the numbers between, which can be 2^62.
            if gap.stop > current.newest + 1:
                continue
            if gap.first <= sequence < gap.stop and self._gaps.fill(gap, sequence):
                self.num_late += 1
                return True
        return False

    def _interrupt(self, current: _Numbering, sequence: int, utime: int, session: int) -> None:
        """Take a number that does not follow the newest one: of a former numbering, or of a new one."""
        former = self._find_former(current, sequence)
        if former is not None:
            self._resume(former, current)
            self.add(sequence, utime, session)
            return
        gaps = current.gaps
        is_restart = sequence <= current.newest or session < self.session
        if is_restart:
            current.is_restart = True
            self.num_restarts += 1
            gaps = deque(maxlen=_NUM_RECENT)
        num_lost = sequence - current.newest - 1
        if is_restart:
            num_lost = max(0, sequence) if self._counts_first else 0
        if num_lost:
            current.gap = gap = Gap(utime, num_lost, sequence)
            self._add_gap(gap, gaps)
        self._former.append(current)
        self._current = _Numbering(sequence, utime, 1, gaps)

    def _add_gap(self, gap: Gap, gaps: deque[Gap]) -> None:
        gaps.append(gap)
        self._gaps.add(gap)

    def _find_former(self, current: _Numbering, sequence: int) -> _Numbering | None:
        """Return the interrupted numbering that a message continues; None if it continues none."""
        for each in self._former:
            if sequence == each.newest + 1:
                return each
        if current.num_messages > 1:
            return None
        # The message between may have been damaged or late, and the one after it lost.
        followed = [each for each in (current, *self._former) if 0 < sequence - each.newest <= _MAX_GAP]
        nearest = max(followed, key=lambda each: each.newest, default=current)
        return None if nearest is current else nearest

    def _resume(self, former: _Numbering, current: _Numbering) -> None:
        """Continue a numbering, and undo what was counted when it was interrupted."""
        self._former.remove(former)
        self.num_alternations += 1
        self.num_implausible += current.num_messages == 1
        self.num_restarts -= former.is_restart
        if (gap := former.gap) is not None:
            self._gaps.remove(gap)
            former.gaps = deque((each for each in former.gaps if each is not gap), _NUM_RECENT)
        former.gap, former.is_restart = None, False
        current.gap, current.is_restart = None, False
        self._former.append(current)
        self._current = former
