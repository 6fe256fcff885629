"""Finding lost messages by their sequence numbers."""

import struct
from collections import deque
from typing import Final, NamedTuple

from gateway.messages.encode import FINGERPRINT_BYTES
from gateway.messages.stamp import NOT_PUBLISHED

PREFIX_END: Final = 40
"""The length of the shortest message that has a prefix."""

_FORMER: Final = 4
_MANY_ALTERNATIONS: Final = 10

_FIELDS: Final = struct.Struct(">qqqi")
"""The prefix up to the session: utime, capture_utime, sequence, session."""


class _Former(NamedTuple):
    """A numbering that seemed to end: its next number, and what was counted when another number came."""

    expected: int
    num_lost: int
    num_gaps: int
    num_restarts: int


class SequenceCheck:
    """Follows the sequence numbers of one key or channel, and counts what is missing.

    Numbers before the first message are not missing. If the numbers start again, the gateway has restarted,
    and its first messages may be missing. If a numbering goes on after another one has begun, nothing was
    missing between them: either one message was late, or two gateways publish on the same key or channel.
    """

    def __init__(self) -> None:
        self.num_lost = 0
        """How many messages are missing."""
        self.num_gaps = 0
        """In how many places they are missing."""
        self.num_restarts = 0
        """How often the numbers started again."""
        self.num_repeated = 0
        """How many messages came twice."""
        self.num_alternations = 0
        """How often a former numbering went on."""
        self.first_utime = 0
        self.last_utime = 0
        """The times of the first and the newest message, in µs since the Unix epoch."""
        self.session = 0
        """The session of the newest message."""
        self._expected: int | None = None
        self._former: deque[_Former] = deque(maxlen=_FORMER)

    @property
    def has_two_publishers(self) -> bool:
        """Whether two gateways publish, as far as the numbers show. Then losses are not counted exactly."""
        return self.num_alternations >= _MANY_ALTERNATIONS

    def add(self, message: bytes) -> None:
        """Take the next message, of at least PREFIX_END bytes."""
        utime, _, sequence, session = _FIELDS.unpack_from(message, FINGERPRINT_BYTES)
        if sequence == self._expected:
            self._expected = sequence + 1
        elif sequence == NOT_PUBLISHED or not self._continues(utime, sequence, session):
            return
        self.last_utime = utime
        self.session = session

    def _continues(self, utime: int, sequence: int, session: int) -> bool:
        """Take an unexpected number; return False if it is that of the message before, repeated."""
        expected = self._expected
        if expected is None:
            self.first_utime = utime
            self._expected = sequence + 1
            return True
        if sequence == expected - 1 and utime == self.last_utime:
            self.num_repeated += 1
            return False
        former = next((each for each in self._former if each.expected == sequence), None)
        if former is not None:
            self._former.remove(former)
            self._count(-former.num_lost, -former.num_gaps, -former.num_restarts)
            self._former.append(_Former(expected, 0, 0, 0))
            self.num_alternations += 1
        else:
            is_restart = sequence < expected or session < self.session
            num_lost = max(0, sequence if is_restart else sequence - expected)
            counted = (num_lost, int(num_lost > 0), int(is_restart))
            self._former.append(_Former(expected, *counted))
            self._count(*counted)
        self._expected = sequence + 1
        return True

    def _count(self, num_lost: int, num_gaps: int, num_restarts: int) -> None:
        self.num_lost += num_lost
        self.num_gaps += num_gaps
        self.num_restarts += num_restarts
