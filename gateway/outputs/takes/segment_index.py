"""Where the messages of each channel are in a segment, so that a range of them is found by reading little."""

from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from gateway.errors import TakeError
from gateway.messages.history import MAX_ANSWER_BYTES, WantedMessages, sequence_of, utime_of
from gateway.takes.files.event_log import EventLogReader
from gateway.takes.files.take_writer import Messages

STRETCH_BYTES: Final = 256 * 1024
"""A segment has one entry for each channel in a stretch of this size.

An hour of 1.3 MB/s on ten channels needs 4.3 MB of memory.
"""

MAX_READ_BYTES: Final = 8 * 1024 * 1024
"""The most that is read for one answer, unless one stretch is longer."""

MAX_READ_S: Final = 0.5
"""How long to read for one answer, unless one stretch takes longer: others wait for the same thread."""


class Stretch(NamedTuple):
    """A part of a file in which the first message of a channel has the number ``sequence``."""

    path: Path
    begin: int
    end: int
    sequence: int


class Plan(NamedTuple):
    """The stretches to read, in order; ``next`` is the first number that is in none of them."""

    stretches: Sequence[Stretch]
    next: int


class _Places:
    """The stretches of one segment that have messages of one channel; number and time of the first one."""

    def __init__(self) -> None:
        self.sequences = array("q")
        self.utimes = array("q")
        self.stretches = array("q")


class SegmentIndex:
    """The index of one segment. The owner's lock protects it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._begins = array("q")  # of each stretch
        self._end = 0
        self._places: dict[bytes, _Places] = {}
        self._channels: set[bytes] = set()  # in the newest stretch
        self._has_forgotten = False  # something in the newest stretch

    def add(self, begin: int, end: int, messages: Messages) -> None:
        """Take note of messages that were written from ``begin`` to ``end`` in the file."""
        if self._has_forgotten or not self._begins or begin - self._begins[-1] >= STRETCH_BYTES:
            self._begins.append(begin)
            self._channels.clear()
            self._has_forgotten = False
        self._end = end
        firsts = dict(reversed(messages))
        for channel in firsts.keys() - self._channels:
            self._channels.add(channel)
            places = self._places.setdefault(channel, _Places())
            places.sequences.append(sequence_of(firsts[channel]))
            places.utimes.append(utime_of(firsts[channel]))
            places.stretches.append(len(self._begins) - 1)

    def forget(self, channel: bytes) -> None:
        """Forget where the messages of a channel are."""
        if self._places.pop(channel, None) is not None:
            self._has_forgotten = True

    def oldest(self, channel: bytes) -> tuple[int, int] | None:
        """Return number and time of the first message of a channel; None if it has none here."""
        places = self._places.get(channel)
        return None if places is None else (places.sequences[0], places.utimes[0])

    def stretches(self, channel: bytes, wanted: WantedMessages) -> list[Stretch]:
        """Return the stretches that may have wanted messages of a channel, or later ones."""
        places = self._places.get(channel)
        if places is None:
            return []
        if wanted.first is not None:
            num_before = bisect_right(places.sequences, wanted.first)
        else:
            num_before = bisect_left(places.utimes, wanted.since_utime or 0)
        start = max(0, num_before - 1)
        return [
            Stretch(self.path, self._begins[number], self._end_of(number), sequence)
            for sequence, number in zip(places.sequences[start:], places.stretches[start:], strict=True)
        ]

    def _end_of(self, number: int) -> int:
        return self._end if number + 1 == len(self._begins) else self._begins[number + 1]


def plan_reading(
    indices: Sequence[SegmentIndex], channel: bytes, wanted: WantedMessages, newest: int
) -> Plan:
    """Return what to read for messages of a channel, whose newest one has the number ``newest``.

    ``indices`` are those of all segments, the oldest first.
    """
    last = newest if wanted.last is None else min(wanted.last, newest)
    start = 0
    for number in range(len(indices) - 1, 0, -1):
        oldest = indices[number].oldest(channel)
        if oldest is not None and _is_before(wanted, *oldest):
            start = number
            break
    stretches: list[Stretch] = []
    num_bytes = 0
    for index in indices[start:]:
        for stretch in index.stretches(channel, wanted):
            num_bytes += stretch.end - stretch.begin
            if stretch.sequence > last:
                return Plan(stretches, last + 1)
            if stretches and num_bytes > MAX_READ_BYTES:
                return Plan(stretches, stretch.sequence)
            stretches.append(stretch)
    return Plan(stretches, last + 1)


def _is_before(wanted: WantedMessages, sequence: int, utime: int) -> bool:
    """Return whether what is wanted cannot begin before a message with this number and time."""
    if wanted.first is not None:
        return sequence <= wanted.first
    return utime < (wanted.since_utime or 0)


def read_planned(
    plan: Plan, channel: bytes, wanted: WantedMessages, monotonic: Callable[[], float]
) -> tuple[list[bytes], int]:
    """Read messages, MAX_ANSWER_BYTES at most; return them and the number with which to continue.

    What has been deleted since then is left out. On a slow disk, this ends after MAX_READ_S.
    """
    name, first, since_utime = channel.decode(), wanted.first or 0, wanted.since_utime or 0
    messages: list[bytes] = []
    num_bytes = 0
    nexts = [*(stretch.sequence for stretch in plan.stretches), plan.next][1:]
    end_s = monotonic() + MAX_READ_S
    for number, (stretch, following) in enumerate(zip(plan.stretches, nexts, strict=True)):
        if number and monotonic() > end_s:
            return messages, stretch.sequence
        try:
            for event in EventLogReader(stretch.path).events(stretch.begin, stretch.end):
                if event.channel != name:
                    continue
                sequence = sequence_of(event.message)
                if sequence >= following:
                    break
                if sequence >= first and (messages or event.utime >= since_utime):
                    num_bytes += len(event.message)
                    if messages and num_bytes > MAX_ANSWER_BYTES:
                        return messages, sequence
                    messages.append(event.message)
                if sequence + 1 == following:
                    break
        except TakeError:
            continue
    return messages, plan.next
