"""What a fault is, and the faults of a connection's bytes, of single moments, and of the server.

A fault is lasting or momentary, for all connections or one, with parameters of its own.
"""

# ruff: noqa: ARG002 - hooks: not every kind needs every argument
import asyncio
import math
import re
from collections.abc import Callable
from typing import Annotated, Any, ClassVar, Final, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator
from typing_extensions import override

from gateway.config.section import Section, expects, validation_error
from gateway.rtc3d.packets import PACKET_HEADER, Packet, PacketType
from gateway.simulator.synthetic import Label, SceneSettings

MAX_SECONDS: Final = 86400

Seconds = Annotated[
    float,
    Field(strict=True, ge=0, le=MAX_SECONDS, allow_inf_nan=False),
    expects(f"a number of seconds from 0 to {MAX_SECONDS}"),
]
Interval = Annotated[
    float,
    Field(strict=True, ge=0.01, le=MAX_SECONDS, allow_inf_nan=False),
    expects(f"a number of seconds from 0.01 to {MAX_SECONDS}"),
]
Milliseconds = Annotated[
    float,
    Field(strict=True, gt=0, le=600_000, allow_inf_nan=False),
    expects("a number of milliseconds above 0, up to 600000"),
]
Count = Annotated[int, Field(strict=True, ge=1, le=1_000_000), expects("a whole number from 1 to 1000000")]


class Fault(Section):
    """A kind of fault with its parameters and times; it can begin any number of times.

    ``str`` returns it in the form of the command line: ``delay,delay_ms=80,for_s=3``.
    """

    kind: ClassVar[str]
    """The kind's name in scenarios and on the command line: that of the class, in lower case with _."""

    at_s: Seconds | None = None
    """Begin this many seconds after the start."""

    every_s: Interval | None = None
    """Begin repeatedly, at intervals of this many seconds, varied at random by up to half."""

    times: Count | None = None
    """Do not happen again after this many times."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.kind = re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()

    def __str__(self) -> str:
        return ",".join([self.kind, *_assignments(self.model_dump(exclude_unset=True))])


def _assignments(values: dict[str, Any], prefix: str = "") -> list[str]:
    """Return NAME=VALUE for each value, and MAPPING.NAME=VALUE for each value of a mapping."""
    texts: list[str] = []
    for name, value in values.items():
        if isinstance(value, dict):
            texts += _assignments(value, f"{prefix}{name}.")
        else:
            texts.append(f"{prefix}{name}={parameter_text(value)}")
    return texts


def parameter_text(value: object) -> str:
    """Return a parameter's value in the form of the command line."""
    match value:
        case bool():
            return "true" if value else "false"
        case float():
            return f"{value:.12g}"
        case tuple() | list():
            return f"[{','.join(map(parameter_text, value))}]"
    return str(value)


class ActiveFault:
    """A fault on one server: when it begins, what it changed, and its random numbers.

    A fault with ``every_s`` begins repeatedly, others once.
    """

    def __init__(self, fault: Fault, rng: np.random.Generator) -> None:
        self.fault = fault
        # Two generators, so that the timing does not depend on how many packets the fault changed.
        self.rng, self._timing_rng = rng.spawn(2)
        self.ended = asyncio.Event()
        self.num_happened = 0
        """How often it happened: packets, replies or reads that it changed; for other faults, beginnings."""
        self.variant = 0
        """A random number, different each time the fault begins."""
        self.timestamp_us: int | None = None
        """The time stamp of the first frame since the fault last began, if the fault remembers it."""
        self.undo: Callable[[], None] | None = None
        """What undoes the fault at its end."""
        self.end_timer: asyncio.TimerHandle | None = None

    @property
    def is_exhausted(self) -> bool:
        """Whether the fault has happened as often as its ``times`` allows."""
        return self.fault.times is not None and self.num_happened >= self.fault.times

    def first_delay_s(self) -> float:
        """Return the time from the start of the simulator until the fault first begins."""
        if self.fault.at_s is not None or self.fault.every_s is None:
            return self.fault.at_s or 0.0
        return self.random_interval_s(self.fault.every_s)

    def random_interval_s(self, every_s: float) -> float:
        """Return a random time from one beginning to the next: 50 to 150 % of ``every_s``."""
        return every_s * float(self._timing_rng.uniform(0.5, 1.5))

    def begin(self) -> None:
        """Forget what belongs to an earlier time that the fault was active."""
        self.ended.clear()
        self.variant = int(self._timing_rng.integers(2**31))
        self.timestamp_us = None

    def cancel_end(self) -> None:
        """Cancel the automatic end."""
        if self.end_timer is not None:
            self.end_timer.cancel()
            self.end_timer = None


class LastingFault(Fault):
    """A fault that lasts until it ends."""

    for_s: Interval | None = None
    """Last this many seconds; by default, until the simulator ends."""

    @model_validator(mode="after")
    def _ends_before_it_begins_again(self) -> Self:
        if self.every_s is not None and self.for_s is None:
            raise validation_error("found every_s without for_s; expected both", "every_s")
        return self


class ConnectionFault(Fault):
    """A fault that affects connections."""

    connection: Count | None = None
    """Affect only the n-th connection since the server's start; by default, all."""

    def applies_to(self, number: int) -> bool:
        """Return whether the fault affects the connection with this number."""
        return self.connection in {None, number}


class PendingWrite(NamedTuple):
    """Bytes to write to a client's socket: one packet, until a fault changes it."""

    due_s: float
    """When to write them, in s on the monotonic clock; never before earlier writes."""

    data: bytes

    joins_previous: bool = False
    """Whether to write these bytes and the previous ones with one send, if both are due."""


class Reply(NamedTuple):
    """A reply to a command, one packet; it is sent at once unless it is delayed."""

    packet: bytes

    delay_s: float = 0.0
    """How much later it is sent; other packets do not wait for it."""

    after_frames: int = 0
    """The number of data frames to send before it; a No Data packet ends the wait."""


class LastingConnectionFault(ConnectionFault, LastingFault):
    """A fault that changes the bytes of connections, including later ones, until it ends.

    ``times`` counts the packets, replies or reads that it changed.
    """

    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        """Return the writes instead of ``writes``, which are one packet as changed by the previous faults."""
        return writes

    def refusal(self, command: Packet) -> str | None:
        """Return why the server refuses a client's packet; None if it does not refuse it."""
        return None

    def change_replies(self, command: Packet, replies: list[Reply]) -> list[Reply]:
        """Return the replies to a client's packet instead of ``replies``."""
        return replies

    def read_delay_s(self, num_bytes: int) -> float:
        """Return how long the server takes to read ``num_bytes``; math.inf means until the fault ends."""
        return 0.0


class MomentaryFault(ConnectionFault):
    """A fault that happens to connections at one moment: bytes that no server sends."""

    def data(self, rng: np.random.Generator) -> bytes:
        """Return the bytes to send on a connection."""
        raise NotImplementedError


def packet_type_of(packet: bytes) -> int:
    """Return a packet's type (§4.2); -1 for bytes that are not a packet."""
    return int.from_bytes(packet[4:8], "big") if len(packet) >= 8 else -1


Pieces = Annotated[int, Field(strict=True, ge=2, le=1000), expects("a whole number from 2 to 1000")]
Speed = Annotated[
    float,
    Field(strict=True, gt=0, le=1e9, allow_inf_nan=False),
    expects("a number of bytes per second above 0, up to 1e9"),
]


class Split(LastingConnectionFault):
    """The server sends each packet in several pieces of random size."""

    pieces: Pieces = 3
    """The number of pieces; a packet of fewer bytes is sent byte by byte."""

    pause_ms: Milliseconds = 1.0
    """Milliseconds between two pieces."""

    @override
    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        pieces = []
        pause_s = self.pause_ms / 1000
        for write in writes:
            size = len(write.data)
            num_cuts = min(self.pieces, size) - 1
            cuts = sorted(active.rng.choice(size - 1, num_cuts, replace=False) + 1) if num_cuts > 0 else []
            for index, (start, stop) in enumerate(zip([0, *cuts], [*cuts, size], strict=True)):
                due_s = write.due_s + index * pause_s
                pieces.append(write._replace(due_s=due_s, data=write.data[start:stop]))
        return pieces


class Merge(LastingConnectionFault):
    """The server collects packets and sends several at once."""

    window_ms: Milliseconds = 20.0
    """How long the server collects packets, in milliseconds."""

    @override
    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        window_s = self.window_ms / 1000
        return [
            write._replace(due_s=math.ceil(write.due_s / window_s) * window_s, joins_previous=True)
            for write in writes
        ]


class Delay(LastingConnectionFault):
    """The server sends everything late."""

    delay_ms: Milliseconds = 100.0
    """The delay in milliseconds."""

    @override
    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        return [write._replace(due_s=write.due_s + self.delay_ms / 1000) for write in writes]


class Jitter(LastingConnectionFault):
    """The server sends each packet late by a random time (exponential distribution), in order."""

    mean_ms: Milliseconds = 5.0
    """The mean delay in milliseconds."""

    @override
    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        delay_s = float(active.rng.exponential(self.mean_ms / 1000))
        return [write._replace(due_s=write.due_s + delay_s) for write in writes]


class HalfOpen(LastingConnectionFault):
    """The server neither reads nor writes nor closes connections; what it would have sent is lost."""

    @override
    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        return []

    @override
    def read_delay_s(self, num_bytes: int) -> float:
        return math.inf


class SlowReader(LastingConnectionFault):
    """The server reads commands slowly."""

    bytes_per_s: Speed = 100.0
    """The speed in bytes per second."""

    @override
    def read_delay_s(self, num_bytes: int) -> float:
        return num_bytes / self.bytes_per_s


NumBytes = Annotated[int, Field(strict=True, ge=1, le=1_000_000), expects("a whole number from 1 to 1000000")]
TooLarge = Annotated[
    int, Field(strict=True, ge=9, le=0xFFFFFFFF), expects("a whole number of bytes from 9 to 4294967295")
]
TooSmall = Annotated[int, Field(strict=True, ge=0, le=7), expects("a whole number of bytes from 0 to 7")]
Switch = Annotated[bool, Field(strict=True), expects("true or false")]


class Garbage(MomentaryFault):
    """The server sends random bytes between two packets."""

    num_bytes: NumBytes = 64
    """The number of bytes."""

    @override
    def data(self, rng: np.random.Generator) -> bytes:
        return rng.bytes(self.num_bytes)


class _WrongSize(MomentaryFault):
    size_bytes: int

    @override
    def data(self, rng: np.random.Generator) -> bytes:
        return PACKET_HEADER.pack(self.size_bytes, PacketType.DATA)


class Oversize(_WrongSize):
    """The server sends a packet header that announces more bytes than follow."""

    size_bytes: TooLarge = 0xFFFFFFFF
    """The value of the size field."""


class Undersize(_WrongSize):
    """The server sends a packet header that announces fewer bytes than the header itself has."""

    size_bytes: TooSmall = 0
    """The value of the size field."""


class Cut(MomentaryFault):
    """Connections end in the middle of a packet."""

    reset: Switch = False
    """End connections with RST instead of FIN, as a server's computer does after a restart."""

    @override
    def data(self, rng: np.random.Generator) -> bytes:
        return PACKET_HEADER.pack(1000, PacketType.DATA) + bytes(100)


class NoMeasurement(LastingFault):
    """The measurement stops; when the fault ends, a new one starts."""


class ChangeScene(LastingFault):
    """Markers, tools and so on change during the measurement; when the fault ends, they change back."""

    scene: SceneSettings = SceneSettings(markers=12)
    """The changes to the scenario's scene; by default, it gets 12 markers."""


class Rename(LastingFault):
    """Somebody renames all markers and tools; when the fault ends, they have their former names."""

    prefix: Label = "New "
    """The text before each former name."""


class Restart(Fault):
    """The server crashes and comes back on the same port with a new measurement."""

    away_s: Seconds = 1.0
    """Seconds until the server comes back."""

    scene: SceneSettings = SceneSettings()
    """The changes to the scenario's scene; by default, none."""


SERVER_FAULTS: Final = (NoMeasurement, ChangeScene, Rename, Restart)
"""What these do is in ``simulator.Faults``, which has the server."""
STREAM_FAULTS: Final = (Split, Merge, Delay, Jitter, HalfOpen, SlowReader)
MOMENTARY_FAULTS: Final = (Garbage, Oversize, Undersize, Cut)
