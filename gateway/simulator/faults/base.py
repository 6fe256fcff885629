"""The base classes of all faults: when they happen, for how long, and what they can change."""

# ruff: noqa: ARG002 - hooks: not every kind needs every argument
import asyncio
import re
from collections.abc import Callable
from typing import Annotated, Any, ClassVar, Final, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from gateway.config.section import Section, expects, validation_error
from gateway.rtc3d.packets import Packet

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

    @property
    def lasts_s(self) -> float | None:
        """How long the fault lasts: 0 means a moment, None means until it is ended."""
        return 0.0

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

    @property
    def lasts_s(self) -> float | None:
        """See Fault."""
        return self.for_s


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
