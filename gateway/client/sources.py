"""A source of which something was received, and the messages of each of its keys."""

import math
import struct
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import rtc3d

from gateway.client.completion import Completion
from gateway.errors import ProtocolError
from gateway.messages.decode import decode
from gateway.messages.encode import FINGERPRINT_BYTES, MESSAGE_TYPES, NOT_PUBLISHED
from gateway.messages.sequence_check import SequenceCheck
from gateway.rtc3d.components import COMPONENTS_BY_KEY

PREFIX_END: Final = 40
"""The length of the shortest message that has a prefix."""

FIELDS: Final = struct.Struct(">qqqi")
"""The prefix up to the session: utime, capture_utime, sequence, session."""

_AGAIN_S: Final = 0.3
"""When a query is repeated that got no answer, as may happen while Zenoh connects."""

_MAX_AGAIN_S: Final = 10.0

POSE: Final = "6d/"
"""What the keys of tool poses begin with."""

TYPES_BY_KEY: Final[dict[str, type[Any]]] = {
    **{component.key: message_type for component, message_type in MESSAGE_TYPES.items()},
    "status": rtc3d.status_t,
    "clock": rtc3d.clock_t,
    "parameters": rtc3d.parameters_t,
    POSE: rtc3d.tool_pose_t,
}
"""The types of the messages by the part of their keys below the source."""

FINGERPRINTS: Final[dict[str, bytes]] = {
    key: message_type._get_packed_fingerprint()  # noqa: SLF001 - lcm-gen offers no other way
    for key, message_type in TYPES_BY_KEY.items()
}


_MAX_LISTED: Final = 8
"""How many places are listed where messages are missing. All are counted."""


class ReceivedSeries:
    """The messages of one key of a source. ``row`` is its line in tables: the key, or 6d/* for poses."""

    def __init__(self, source: "ReceivedSource", key: str, channel: str) -> None:
        self.source = source
        self.key = key
        self.row = f"{POSE}*" if key.startswith(POSE) else key
        self.channel = channel.encode()
        self.check = SequenceCheck(counts_first=True, max_listed=_MAX_LISTED)
        self.completion: Completion | None = None
        """What fills the gaps, if that is wanted; then the messages are counted after it."""
        self.first_utime = 0
        self.last_utime = 0
        """The times of the first and the newest message with a number, in µs since the Unix epoch."""
        self.num_messages = 0
        """How many messages have arrived."""
        self.num_bytes = 0
        self._fingerprint = FINGERPRINTS[POSE if key.startswith(POSE) else key]

    @property
    def has_data(self) -> bool:
        """Whether these are messages of frames."""
        return self.key in COMPONENTS_BY_KEY or self.key.startswith(POSE)

    def accepts(self, message: bytes) -> bool:
        """Whether the message has the type of the series."""
        return message[:8] == self._fingerprint and len(message) >= PREFIX_END

    def count(self, message: bytes) -> None:
        """Count a message, and those that are missing before it."""
        self.add(message)
        utime, _, sequence, session = FIELDS.unpack_from(message, FINGERPRINT_BYTES)
        if sequence != NOT_PUBLISHED:
            self.first_utime = self.first_utime or utime
            self.last_utime = utime
            self.check.add(sequence, utime, session)

    def add(self, message: bytes) -> None:
        """Count a message whose number does not matter."""
        self.num_messages += 1
        self.num_bytes += len(message)


class ReceivedSource:
    """A source of which something was received. ``channels`` is the beginning of its channels."""

    def __init__(self, name: str, channels: str, monotonic: Callable[[], float] = time.monotonic) -> None:
        self.name = name
        self.channels = channels
        self.has_known_name = False
        """Whether a gateway or the user has said the name; otherwise, it is made from the channels."""
        self.heard_s: float | None = None
        """When the newest message arrived, on the monotonic clock; None before the first."""
        self.status: bytes | None = None
        """The newest status, or that of a query."""
        self.parameters: bytes | None = None
        """The newest ``parameters_t``."""
        self.num_parameters = 0
        """How many ``parameters_t`` were made of the parameters from Zenoh."""
        self.running_take: str | None = None
        """The name of the take that its gateway records; "" if none, None if it is not known."""
        self.routers: Sequence[str] | None = None
        """The names of the Zenoh routers between, the gateway's first; None if they are not known."""
        self.has_answer = False
        """Whether a gateway has answered the query for the parameters, or published them."""
        self.series_by_key: dict[str, Any] = {}
        self.found_s = monotonic()
        self._monotonic = monotonic
        self._queried_s = -math.inf

    @property
    def is_waiting(self) -> bool:
        """Whether a query for the parameters or the status is still to be answered."""
        return self.status is None or not self.has_answer

    def begin_query(self) -> bool:
        """Return whether it is time for a query about the source, and note that it is made.

        If a gateway does not reply, the queries become rarer: from every 0.3 s to every 10 s.
        """
        now_s = self._monotonic()
        again_s = min(max(_AGAIN_S, (now_s - self.found_s) / 10), _MAX_AGAIN_S)
        if now_s - self._queried_s < again_s:
            return False
        self._queried_s = now_s
        return True

    @property
    def series(self) -> list[Any]:
        """The series so far; other threads may add some at any time."""
        return [*self.series_by_key.values()]

    @property
    def first_utime(self) -> int | None:
        """The time of its first message, in µs since the Unix epoch; None before."""
        times = [each.first_utime for each in self.series if each.first_utime]
        return min(times, default=None)

    @property
    def last_utime(self) -> int | None:
        """The time of its newest message, in µs since the Unix epoch; None before the first."""
        times = [each.last_utime for each in self.series if each.last_utime]
        return max(times, default=None)

    @property
    def session(self) -> int:
        """The newest session."""
        return max((each.check.session for each in self.series), default=0)

    def decoded_status(self) -> Any | None:
        """Return the newest status as ``status_t``; None if there is none that can be read."""
        try:
            return None if self.status is None else decode(self.status)
        except ProtocolError:
            return None
