"""The prefix of every message: times, sequence number and session of its frame."""

import struct
from typing import Final

PREFIX: Final = struct.Struct(">qqqi")
"""The fields after the fingerprint: utime, capture_utime, sequence, session."""

NOT_PUBLISHED: Final = -1
"""The sequence number of a message that answers a query and is not part of a stream."""

_pack: Final = PREFIX.pack
_NO_SEQUENCE: Final = 1 << 63  # larger than any: sequence numbers are signed and have 64 bits


class Stamp:
    """What the messages of one frame have in common in their prefixes.

    ``utime`` is when the frame arrived and ``capture_utime`` when the server captured it, both in µs since
    the Unix epoch; ``session`` is the number of the connection. ``has_clock`` is False where the server's
    time stamps cannot be used as a clock.
    """

    __slots__ = ("_prefix", "_sequence", "capture_utime", "has_clock", "session", "utime")

    def __init__(self, utime: int, capture_utime: int, session: int, has_clock: bool = True) -> None:
        self.utime = utime
        self.capture_utime = capture_utime
        self.session = session
        self.has_clock = has_clock
        self._sequence = _NO_SEQUENCE  # the number in _prefix
        self._prefix = b""

    def prefix(self, sequence: int) -> bytes:
        """Return the prefix of a message with this sequence number: 28 bytes.

        Most messages of a frame have the same number, so the last prefix is kept: benchmarks/own_cost.py.
        """
        if sequence != self._sequence:
            self._sequence = sequence
            self._prefix = _pack(self.utime, self.capture_utime, sequence, self.session)
        return self._prefix
