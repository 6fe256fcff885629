"""What has arrived of one run of a gateway, and waits to be handed on in the order of its numbers."""

from array import array
from collections.abc import Callable, Sequence
from typing import Final

from gateway.messages.history import utime_of
from gateway.messages.sequence_check import MAX_LATE

MAX_HELD_BYTES: Final = 32 * 1024 * 1024
"""How much all series of a subscriber hold together while they wait: 20 s of a dense stream at 1000 Hz."""

_ENTRY_BYTES: Final = 128
"""What a held message takes besides its content."""

_NUM_RECENT: Final = 1024
"""How many messages that were handed on are remembered: more than MAX_LATE, and a power of two."""


class HeldBytes:
    """How much the series of a subscriber hold together, and how much they may."""

    def __init__(self, limit: int = MAX_HELD_BYTES) -> None:
        self.limit = limit
        self.used = 0


class ArrivedRun:
    """The messages of one run of a gateway that are held, and the newest one that has arrived."""

    def __init__(self, room: HeldBytes) -> None:
        self.held: dict[int, bytes] = {}
        """By number. Without room, only the first one is held; the others are let go, to be requested."""
        self.until = -1
        """The largest number that is known to exist."""
        self.newest = -1
        """The largest number that has arrived, with its time and its session."""
        self.newest_utime = 0
        self.newest_session = 0
        self.smallest: tuple[int, int] | None = None
        """The smallest number that has arrived, with its time."""
        self._room = room

    @property
    def first(self) -> int:
        """The smallest number that is held; after the largest that exists, if none is."""
        return min(self.held, default=self.until + 1)

    def is_continued_by(self, sequence: int, utime: int, session: int) -> bool:
        """Whether a message can be one of this run, as far as numbers and times show: newer, or only late."""
        if utime > self.newest_utime:
            return sequence > self.newest and session >= self.newest_session
        return self.newest - sequence <= MAX_LATE

    def note(self, sequence: int, utime: int, session: int) -> None:
        """Note that a message has arrived."""
        self.until = max(self.until, sequence)
        if self.smallest is None or sequence < self.smallest[0]:
            self.smallest = sequence, utime
        if sequence > self.newest:
            self.newest, self.newest_utime, self.newest_session = sequence, utime, session

    def hold(self, sequence: int, message: bytes) -> bool:
        """Hold a message if there is room; the first one always. Return whether it was."""
        num_bytes = len(message) + _ENTRY_BYTES
        room = self._room
        if sequence in self.held or (self.held and room.used + num_bytes > room.limit):
            return False
        self.held[sequence] = message
        room.used += num_bytes
        return True

    def release(self, sequence: int) -> bytes:
        """Hold a message no longer, and return it."""
        message = self.held.pop(sequence)
        self._room.used -= len(message) + _ENTRY_BYTES
        return message

    def is_older_than(self, numbered: Sequence[tuple[int, bytes]], newest: int) -> bool:
        """Whether what is held is of a run before that of the history, which has these messages."""
        if not self.held or not numbered:
            return False
        first = self.first
        message, utime = self.held[first], utime_of(self.held[first])
        if numbered[-1][0] == newest < first:  # a copy of the newest message is no other run
            newest_utime = utime_of(numbered[-1][1])
            return utime < newest_utime or (utime > newest_utime and first > newest + 1)
        return any(
            utime_of(each) > utime if number < first else number == first and each != message
            for number, each in numbered
        )

    def goes_back_before(self, number: int, utime: int) -> bool:
        """Whether it has a smaller number than this one, but a later time: then it is another run.

        A message with a false number can look the same: then one restart too many is reported. That is the
        better mistake, because nothing would say what is missing between two runs.
        """
        return self.smallest is not None and self.smallest[0] <= number and self.smallest[1] > utime

    def let_go_between(self, number: int, utime: float) -> None:
        """Let go what has this number or a larger one, but is older than ``utime``: one of both is false."""
        for each in [each for each, held in self.held.items() if each >= number and utime_of(held) < utime]:
            self.release(each)

    def split(self, is_newer: Callable[[int], bool]) -> "ArrivedRun":
        """Return a run with what has arrived whose time ``is_newer``, and keep the rest."""
        newer = ArrivedRun(self._room)
        for number in sorted(number for number, held in self.held.items() if is_newer(utime_of(held))):
            newer.hold(number, self.release(number))
        if self.newest >= 0 and is_newer(self.newest_utime):
            newer.note(self.newest, self.newest_utime, self.newest_session)
            newer.until = self.until
            self.until = max(self.held, default=-1)
        return newer


class RecentTimes:
    """The times of the messages that were handed on last, by their numbers."""

    def __init__(self) -> None:
        self._numbers = array("q", [-1]) * _NUM_RECENT
        self._utimes = array("q", [0]) * _NUM_RECENT

    def add(self, number: int, utime: int) -> None:
        """Remember a message, instead of an older one."""
        slot = number & (_NUM_RECENT - 1)
        self._numbers[slot], self._utimes[slot] = number, utime

    def contradict(self, number: int, utime: int) -> bool:
        """Whether another message with this number was handed on."""
        slot = number & (_NUM_RECENT - 1)
        return self._numbers[slot] == number and self._utimes[slot] != utime

    def has(self, number: int) -> bool:
        """Whether a message with this number was handed on."""
        return self._numbers[number & (_NUM_RECENT - 1)] == number

    def utime_of(self, number: int, otherwise: int) -> int:
        """Return the time of the message with this number, if it was handed on."""
        return self._utimes[number & (_NUM_RECENT - 1)] if self.has(number) else otherwise

    def clear(self) -> None:
        """Forget all."""
        self._numbers = array("q", [-1]) * _NUM_RECENT
