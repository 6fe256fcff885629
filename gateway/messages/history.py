"""The newest messages of one source, kept so that subscribers can ask for those they have missed.

Those of frames are kept as the frames that arrived, and made again when somebody asks (``frame_run``).
"""

import time
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple

from gateway.errors import ProtocolError
from gateway.messages.encode import FINGERPRINT_BYTES, PREFIX, Stamp
from gateway.messages.frame_run import (
    FRAME_OVERHEAD_BYTES,
    RUN_BYTES,
    FrameMessages,
    FrameRun,
    NumberedLayout,
)
from gateway.messages.host_time import HostClock, host_clock

MAX_ANSWER_BYTES: Final = 200_000
"""How long the messages of one answer may be together, unless a single one is longer."""

MESSAGE_OVERHEAD_BYTES: Final = 48
"""What a message needs in memory besides its bytes: the head of the object, and a reference."""

_BLOCKS: Final = 32
"""A block has at most this part of the memory, so that whole blocks can be dropped."""

_BLOCK_S: Final = 1.0

_LENGTH_BYTES: Final = 4

_CAPTURE_OFFSET: Final = FINGERPRINT_BYTES + 8
_SEQUENCE_OFFSET: Final = FINGERPRINT_BYTES + 16
_SESSION_OFFSET: Final = FINGERPRINT_BYTES + 24


class WantedMessages(NamedTuple):
    """Which messages of a key are wanted: from number ``first``, or since ``since_utime``, up to ``last``.

    One of the first two is None. ``since_utime`` is in µs since the Unix epoch; ``last`` is included, and
    None means the newest message. With ``last_s``, those of so many seconds are wanted, whatever the wall
    clock has shown since then; ``since_utime`` is then for the disk, which does not know their ages.
    """

    first: int | None
    since_utime: int | None = None
    last: int | None = None
    last_s: float | None = None


class FoundMessages(NamedTuple):
    """The messages with the numbers ``first`` to ``last`` that still exist, in order.

    ``oldest`` and ``newest`` are the numbers of the oldest and the newest message of the key that exist.
    """

    messages: Sequence[bytes]
    first: int
    last: int
    oldest: int
    newest: int

    @property
    def facts(self) -> dict[str, Any]:
        """What a peer is told about them."""
        return {
            "from": self.first,
            "to": self.last,
            "oldest": self.oldest,
            "newest": self.newest,
            "num_messages": len(self.messages),
        }


class MessageHistory:
    """The messages of one source by key, for ``seconds`` and in at most ``max_bytes``; 0 keeps nothing.

    The numbers of a key grow, and some may be missing. ``begin_block`` must be called once a second.
    """

    def __init__(self, monotonic: Callable[[], float] = time.monotonic, host: HostClock = host_clock) -> None:
        self._monotonic = monotonic
        self._host = host
        self._steps = host.steps  # of the wall clock, before the newest block
        self._seconds = 0.0
        self._max_bytes = 0
        self._blocks: deque[_Block] = deque([self._new_block(monotonic())])
        self._newest = self._blocks[-1]
        self._run: FrameRun | None = None
        """The newest frames in the newest block; None if it has no frames yet."""

    def set_limits(self, seconds: float, max_bytes: int) -> None:
        """Keep messages within these limits from now on."""
        self._seconds, self._max_bytes = seconds, max_bytes if seconds else 0
        self.begin_block()

    @property
    def is_kept(self) -> bool:
        """Whether anything is kept."""
        return self._max_bytes > 0

    @property
    def num_bytes(self) -> int:
        """How much memory the messages need."""
        return sum(block.num_bytes for block in self._blocks)

    @property
    def overview(self) -> dict[str, Any]:
        """The limits, and what there is of each key."""
        keys = sorted({key for block in self._blocks for key in block.keys})
        found = {key: self._runs(key) for key in keys}
        return {
            "seconds": self._seconds,
            "max_bytes": self._max_bytes,
            "num_bytes": self.num_bytes,
            "keys": {
                key: {
                    "oldest": runs[0].sequence(0),
                    "newest": runs[-1].sequence(len(runs[-1]) - 1),
                    "oldest_utime": runs[0].utime(0),
                    "newest_utime": runs[-1].utime(len(runs[-1]) - 1),
                }
                for key, runs in found.items()
            },
        }

    def add(self, key: str, message: bytes) -> None:
        """Keep a message that belongs to no frame, or that has another number than that of its frame."""
        if self._max_bytes:
            if self._host.steps != self._steps:
                self._append_block(self._monotonic())
            by_key = self._newest.messages
            messages = by_key.get(key)
            if messages is None:
                messages = by_key[key] = []
            messages.append(message)
            self._add_bytes(len(message) + MESSAGE_OVERHEAD_BYTES)

    def add_frame(self, body: bytes, layout: NumberedLayout, stamp: Stamp) -> None:
        """Keep a frame whose messages get the next numbers of their components."""
        if self._max_bytes:
            if self._host.steps != self._steps:
                self._append_block(self._monotonic())
            run = self._run
            if (
                run is None
                or run.layout is not layout
                or run.session != stamp.session
                or run.parameters_version != stamp.parameters_version
            ):
                self._run = run = FrameRun(layout, stamp)
                self._newest.frames.append(run)
                self._newest.num_bytes += RUN_BYTES
            run.bodies.append(body)
            run.utimes.append(stamp.utime)
            run.capture_utimes.append(stamp.capture_utime)
            self._add_bytes(len(body) + FRAME_OVERHEAD_BYTES)

    def _add_bytes(self, num_bytes: int) -> None:
        block = self._newest
        block.num_bytes += num_bytes
        if block.num_bytes * _BLOCKS > self._max_bytes:
            self.begin_block()

    def begin_block(self) -> None:
        """Drop the blocks that are too old or too much, and begin a new one if it is time."""
        now_s = self._monotonic()
        num_bytes = self.num_bytes
        blocks = self._blocks
        while blocks and (num_bytes > self._max_bytes or blocks[0].end_s < now_s - self._seconds):
            num_bytes -= blocks.popleft().num_bytes
        newest = blocks[-1] if blocks else None
        if newest is None or newest.num_bytes * _BLOCKS > self._max_bytes or now_s >= newest.end_s:
            self._append_block(now_s)

    def _append_block(self, now_s: float) -> None:
        self._newest = self._new_block(now_s)
        self._blocks.append(self._newest)
        self._run = None

    def _new_block(self, now_s: float) -> "_Block":
        """Return a block that begins now: between two steps of the wall clock, it tells ages."""
        utime = self._host.read()[0]
        self._steps = self._host.steps
        return _Block(now_s, utime)

    def forget(self, key: str) -> None:
        """Forget the messages of a key, because its numbers begin again."""
        for block in self._blocks:
            messages = block.messages.pop(key, ())
            block.num_bytes -= sum(len(message) + MESSAGE_OVERHEAD_BYTES for message in messages)

    def find(self, key: str, wanted: WantedMessages) -> FoundMessages | None:
        """Return the first of the wanted messages, MAX_ANSWER_BYTES at most; None if the key has none.

        Numbers up to ``last`` of what is returned that are not among its messages exist no more.
        """
        runs = self._runs(key)
        if not runs:
            return None
        oldest, newest = runs[0].sequence(0), runs[-1].sequence(len(runs[-1]) - 1)
        first = wanted.first
        if wanted.last_s is not None:
            first = self._first_of_last(key, wanted.last_s, newest + 1)
        elif first is None:
            since_utime = 0 if wanted.since_utime is None else wanted.since_utime
            first = _first_since(runs, since_utime, newest + 1)
        last = newest if wanted.last is None else min(wanted.last, newest)
        messages: list[bytes] = []
        num_bytes = 0
        for message in _messages_between(runs, first, last):
            num_bytes += len(message)
            if messages and num_bytes > MAX_ANSWER_BYTES:
                last = sequence_of(messages[-1])
                break
            messages.append(message)
        return FoundMessages(messages, first, last, oldest, newest)

    def utime_before(self, key: str, last_s: float) -> int | None:
        """Return the time ``last_s`` ago on the wall clock, as it was set for the oldest message of a key.

        None if the key has no messages.
        """
        for block, end_s, runs in self._blocks_with(key):
            utime = runs[0].utime(0)
            older_s = block.time_s(utime, end_s) - (self._monotonic() - last_s)
            return utime - round(1e6 * older_s)
        return None

    def _first_of_last(self, key: str, last_s: float, otherwise: int) -> int:
        """Return the number of the first message of a key that is not older than ``last_s``."""
        since_s = self._monotonic() - last_s
        for block, end_s, runs in self._blocks_with(key):
            for run in runs:
                if block.time_s(run.utime(len(run) - 1), end_s) >= since_s:
                    return next(
                        run.sequence(position)
                        for position in range(len(run))
                        if block.time_s(run.utime(position), end_s) >= since_s
                    )
        return otherwise

    def _blocks_with(self, key: str) -> list[tuple["_Block", float, "list[_Run]"]]:
        """Return the blocks that have messages of a key, when each ended, and the messages, in order."""
        ends_s = [*(block.begin_s for block in self._blocks), self._monotonic()][1:]
        return [
            (block, end_s, runs)
            for block, end_s in zip(self._blocks, ends_s, strict=True)
            if (runs := block.runs(key))
        ]

    def _runs(self, key: str) -> "list[_Run]":
        """Return the messages of a key, in order."""
        return [run for block in self._blocks for run in block.runs(key)]


class _Messages:
    """Messages of one key that are kept as they were published, the oldest at position 0."""

    def __init__(self, messages: list[bytes]) -> None:
        self._messages = messages

    def __len__(self) -> int:
        return len(self._messages)

    def message(self, position: int) -> bytes:
        """Return the message at a position."""
        return self._messages[position]

    def sequence(self, position: int) -> int:
        """Return its sequence number."""
        return sequence_of(self._messages[position])

    def utime(self, position: int) -> int:
        """Return when it was published, in µs since the Unix epoch."""
        return utime_of(self._messages[position])


_Run = _Messages | FrameMessages


class _Block:
    """The messages of about a second, during which nobody has set the wall clock.

    It began at ``begin_s`` on the monotonic clock, and at ``begin_utime``, in µs since the Unix epoch.
    """

    def __init__(self, begin_s: float, begin_utime: int) -> None:
        self.begin_s = begin_s
        self.end_s = begin_s + _BLOCK_S
        self._begin_utime = begin_utime
        self.messages: dict[str, list[bytes]] = {}
        self.frames: list[FrameRun] = []
        self.num_bytes = 0

    @property
    def keys(self) -> set[str]:
        """The keys that have messages."""
        return {*self.messages, *(key for run in self.frames for key in run.keys)}

    def runs(self, key: str) -> list[_Run]:
        """Return the messages of a key, in order. A key has them all from frames, or none."""
        if messages := self.messages.get(key):
            return [_Messages(messages)]
        return [found for run in self.frames if (found := run.messages(key)) is not None]

    def time_s(self, utime: int, end_s: float) -> float:
        """Return when a message was published, on the monotonic clock; the block ended at ``end_s``.

        A message may have been dated just before the step of the wall clock that begins the block.
        """
        time_s = self.begin_s + 1e-6 * (utime - self._begin_utime)
        return min(max(time_s, self.begin_s), end_s)


def sequence_of(message: bytes) -> int:
    """Return the sequence number of an encoded message."""
    return int.from_bytes(message[_SEQUENCE_OFFSET:_SESSION_OFFSET], "big", signed=True)


def utime_of(message: bytes) -> int:
    """Return when an encoded message was published, in µs since the Unix epoch."""
    return int.from_bytes(message[FINGERPRINT_BYTES:_CAPTURE_OFFSET], "big", signed=True)


def _first_since(runs: "list[_Run]", since_utime: int, otherwise: int) -> int:
    """Return the number of the first message that was published at ``since_utime`` or later."""
    for run in runs:
        if run.utime(len(run) - 1) >= since_utime:
            positions = range(len(run))
            return next(run.sequence(each) for each in positions if run.utime(each) >= since_utime)
    return otherwise


def _messages_between(runs: "list[_Run]", first: int, last: int) -> Iterator[bytes]:
    """Yield the messages with the numbers ``first`` to ``last``."""
    for run in runs:
        if run.sequence(len(run) - 1) >= first:
            positions = range(len(run))
            begin = bisect_left(positions, first, key=run.sequence)
            for position in positions[begin : bisect_right(positions, last, key=run.sequence)]:
                yield run.message(position)


def pack_messages(messages: Sequence[bytes]) -> bytes:
    """Return messages as the payload of an answer: before each, its length as 4 bytes, big-endian."""
    return b"".join(
        part for message in messages for part in (len(message).to_bytes(_LENGTH_BYTES, "big"), message)
    )


def unpack_messages(payload: bytes) -> list[bytes]:
    """Return the messages in the payload of an answer. Raises ProtocolError if it is cut off."""
    messages = []
    offset = 0
    while offset < len(payload):
        begin = offset + _LENGTH_BYTES
        offset = begin + int.from_bytes(payload[offset:begin], "big")
        if offset > len(payload) or begin + PREFIX.size + FINGERPRINT_BYTES > offset:
            raise ProtocolError("an answer with messages from the history is cut off or malformed")
        messages.append(payload[begin:offset])
    return messages
