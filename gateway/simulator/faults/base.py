"""The base classes of all faults: when they happen, for how long, and what they can change."""

# ruff: noqa: ARG002 - hooks: not every kind needs every argument
import asyncio
from collections.abc import Callable, Sequence
from typing import Annotated, Any, ClassVar, Final, NamedTuple, Protocol, Self

import numpy as np
from pydantic import Field, model_validator

from gateway.config.section import Section, expects, validation_error
from gateway.rtc3d.packets import Packet, PacketType
from gateway.simulator.synthetic import SceneSettings


class FaultyConnection(Protocol):
    """What a momentary fault may do to a connection."""

    @property
    def number(self) -> int:
        """The connection's number since the server's start, from 1."""
        ...

    def send_unchanged(self, data: bytes) -> None:
        """Send bytes that no fault changes, after all bytes that are waiting."""
        ...

    def disconnect(self, last_data: bytes, *, reset: bool) -> None:
        """Write ``last_data`` before all bytes that are waiting, and end the connection with FIN or RST."""
        ...


class FaultyServer(Protocol):
    """What a fault may do to the server."""

    @property
    def connections(self) -> Sequence[FaultyConnection]:
        """The clients' connections."""
        ...

    def stop_measurement(self) -> None:
        """Stop the measurement, if one is running."""
        ...

    def start_measurement(self) -> None:
        """Start a measurement, unless another fault prevents it."""
        ...

    def change_scene(self, changes: SceneSettings) -> Callable[[], None]:
        """Serve the scenario's scene with changes; return a function that restores the previous scene."""
        ...

    def rename_items(self, prefix: str) -> Callable[[], None]:
        """Put ``prefix`` before the names of markers and tools; return a function that restores the scene."""
        ...

    def crash(self) -> None:
        """End as if the process died."""
        ...

    def restart(self) -> None:
        """Listen again after a crash, unless another fault prevents it."""
        ...


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

    @property
    def is_held(self) -> bool:
        """Whether the reply is delayed."""
        return bool(self.delay_s or self.after_frames)


def packet_type_of(packet: bytes) -> int:
    """Return a packet's type (§4.2); -1 for bytes that are not a packet."""
    return int.from_bytes(packet[4:8], "big") if len(packet) >= 8 else -1


def is_acknowledgement(packet: bytes) -> bool:
    """Return whether a reply reports success: type 1, whatever its text (field note 1)."""
    return packet_type_of(packet) == PacketType.COMMAND


class ActiveFault:
    """A fault on one server: begins and ends it, counts what it changed, and has its random numbers.

    A fault with ``every_s`` begins repeatedly, others once.
    """

    def __init__(self, fault: "Fault", server: FaultyServer, rng: np.random.Generator) -> None:
        self.fault = fault
        self.server = server
        # Two generators, so that the timing does not depend on how many packets the fault changed.
        self.rng, self._timing_rng = rng.spawn(2)
        self.ended = asyncio.Event()
        self.num_happened = 0
        """How often it happened: packets, replies or reads that it changed; for other faults, beginnings."""
        self.variant = 0
        """A random number, different each time the fault begins."""
        self.timestamp_us: int | None = None
        """The time stamp of the first frame since the fault last began, if the fault remembers it."""
        self._undo: Callable[[], None] | None = None
        self._end_timer: asyncio.TimerHandle | None = None

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
        """Begin the fault."""
        self.ended.clear()
        self.variant = int(self._timing_rng.integers(2**31))
        self.timestamp_us = None
        self._undo = self.fault.begin(self)

    def end_after(self, seconds: float, end: Callable[["ActiveFault"], None]) -> None:
        """Call ``end`` with this fault after ``seconds``; at once if they are 0."""
        if seconds:
            self._end_timer = asyncio.get_running_loop().call_later(seconds, end, self)
        else:
            end(self)

    def end(self) -> None:
        """End the fault."""
        self.cancel_end()
        if self._undo is not None:
            self._undo()
        self.ended.set()

    def cancel_end(self) -> None:
        """Cancel the automatic end."""
        if self._end_timer is not None:
            self._end_timer.cancel()
            self._end_timer = None


class Fault(Section):
    """A kind of fault with its parameters and times; it can begin any number of times.

    ``str`` returns it in the form of the command line: ``delay,delay_ms=80,for_s=3``.
    """

    kind: ClassVar[str]
    """The kind's name in scenarios and on the command line."""

    at_s: Seconds | None = None
    """Begin this many seconds after the start."""

    every_s: Interval | None = None
    """Begin repeatedly, at intervals of this many seconds, varied at random by up to half."""

    times: Count | None = None
    """Do not happen again after this many times."""

    @property
    def lasts_s(self) -> float | None:
        """How long the fault lasts: 0 means a moment, None means until ``end`` is called."""
        return 0.0

    def begin(self, active: ActiveFault) -> Callable[[], None] | None:
        """Begin; return a function that undoes it, or None if there is nothing to undo."""
        return None

    def __str__(self) -> str:
        return ",".join([self.kind, *_assignments(self.model_dump(exclude_unset=True))])


class ConnectionFault(Fault):
    """A fault that affects connections."""

    connection: Count | None = None
    """Affect only the n-th connection since the server's start; by default, all."""

    def applies_to(self, number: int) -> bool:
        """Return whether the fault affects the connection with this number."""
        return self.connection in {None, number}


class MomentaryFault(ConnectionFault):
    """A fault that happens to connections at one moment."""

    def begin(self, active: ActiveFault) -> None:
        """Act on every affected connection."""
        for connection in active.server.connections:
            if self.applies_to(connection.number):
                self.act_on(connection, active)

    def act_on(self, connection: FaultyConnection, active: ActiveFault) -> None:
        """Act on one connection."""
        raise NotImplementedError


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


def _assignments(values: dict[str, Any], prefix: str = "") -> list[str]:
    """Return NAME=VALUE for each value, and MAPPING.NAME=VALUE for each value of a mapping."""
    texts: list[str] = []
    for name, value in values.items():
        if isinstance(value, dict):
            texts += _assignments(value, f"{prefix}{name}.")
        else:
            texts.append(f"{prefix}{name}={parameter_text(value)}")
    return texts
