"""The prefix of every message: times, sequence number, session and version of the parameters."""

import struct
from typing import Final

PREFIX: Final = struct.Struct(">qqqii")
"""The fields after the fingerprint: utime, capture_utime, sequence, session, parameters_version."""

NOT_PUBLISHED: Final = -1
"""The sequence number of a message that only answers a query and is published on no output."""

_pack: Final = PREFIX.pack
_NO_SEQUENCE: Final = 1 << 63  # larger than any sequence number: those are signed 64-bit integers


class Stamp:
    """The part of the prefix that all messages of one frame share.

    ``utime`` is when the frame arrived and ``capture_utime`` when the server captured it, both in µs since
    the Unix epoch. ``session`` is the number of the connection. ``parameters_version`` grows whenever the
    server's parameters change; 0 before the first. ``has_clock`` is False if the server's time stamps cannot
    be used as a clock; then both times are equal.
    """

    __slots__ = (
        "_prefix",
        "_sequence",
        "capture_utime",
        "has_clock",
        "parameters_version",
        "session",
        "utime",
    )

    def __init__(
        self,
        utime: int,
        capture_utime: int,
        session: int,
        parameters_version: int,
        has_clock: bool = True,
    ) -> None:
        self.utime = utime
        self.capture_utime = capture_utime
        self.session = session
        self.parameters_version = parameters_version
        self.has_clock = has_clock
        self._sequence = _NO_SEQUENCE  # the number in _prefix
        self._prefix = b""

    def prefix(self, sequence: int) -> bytes:
        """Return the prefix, 32 bytes, of a message with this sequence number.

        Most messages of a frame have the same number, so it caches the last prefix (benchmarks/own_cost.py).
        """
        if sequence != self._sequence:
            self._sequence = sequence
            self._prefix = _pack(
                self.utime, self.capture_utime, sequence, self.session, self.parameters_version
            )
        return self._prefix
