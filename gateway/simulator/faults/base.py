"""What every fault has: when it happens, for how long, and what of the server it may change."""

# ruff: noqa: ARG002 - hooks: not every kind needs every argument

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from gateway.config.section import Section, expects, validation_error
from gateway.rtc3d.packets import Packet, PacketType

if TYPE_CHECKING:
    from gateway.rtc3d_server.client_connection import ClientConnection
    from gateway.rtc3d_server.server import Simulator
    from gateway.simulator.faults.line import Line

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


def type_of(packet: bytes) -> int:
    """Return a packet's type (§4.2); -1 for bytes that are no packet."""
    return int.from_bytes(packet[4:8], "big") if len(packet) >= 8 else -1


def is_acknowledgement(reply: bytes) -> bool:
    """Return whether the packet says that a command succeeded: type 1 (field note 1)."""
    return type_of(reply) == PacketType.COMMAND


class Chunk(NamedTuple):
    """Bytes to be sent to a client: at first one packet, with one send."""

    when_s: float
    """When they are to leave, on the monotonic clock in s, unless earlier ones leave later."""
    data: bytes
    joins: bool = False
    """Whether they go into one send with those before them, if these leave now as well."""


class Run:
    """A fault at work on a simulator: begun once, or again and again if it has ``every_s``."""

    def __init__(self, fault: Fault, simulator: Simulator, rng: np.random.Generator) -> None:
        self.fault = fault
        self.simulator = simulator
        # apart, so that when it begins does not depend on how many packets it changed
        self.rng, self._plan = rng.spawn(2)
        self.is_over = asyncio.Event()
        self.times = 0
        """How often it happened: packets, replies or reads that it changed; of other faults, beginnings."""
        self.variant = 0
        """A number that is another at random each time the fault begins."""
        self.began_us = 0
        """The measurement's time when the fault last began."""
        self._undo: Callable[[], None] | None = None
        self._timer: asyncio.TimerHandle | None = None

    @property
    def is_spent(self) -> bool:
        """Whether it happened as many times as it may."""
        return self.fault.times is not None and self.times >= self.fault.times

    def first_wait_s(self) -> float:
        """Return how long after the start it begins."""
        if self.fault.at_s is not None or self.fault.every_s is None:
            return self.fault.at_s or 0.0
        return self.next_wait_s(self.fault.every_s)

    def next_wait_s(self, every_s: float) -> float:
        """Return how long after a beginning it begins again."""
        return every_s * float(self._plan.uniform(0.5, 1.5))

    def begin(self) -> None:
        """Begin the fault."""
        self.is_over.clear()
        self.variant = int(self._plan.integers(2**31))
        self.began_us = self.simulator.elapsed_us() or 0
        self._undo = self.fault.begin(self)

    def end_after(self, seconds: float, end: Callable[[Run], None]) -> None:
        """Have it ended in so many seconds, at once if they are 0."""
        if seconds:
            self._timer = asyncio.get_running_loop().call_later(seconds, end, self)
        else:
            end(self)

    def end(self) -> None:
        """End the fault."""
        self.cancel()
        if self._undo is not None:
            self._undo()
        self.is_over.set()

    def cancel(self) -> None:
        """Take it that the fault does not end by itself."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


class Fault(Section):
    """A kind's parameters, and when it happens. The same ``Fault`` can be begun any number of times.

    ``str`` gives it in the command line's form: ``delay,delay_ms=80,for_s=3``.
    """

    kind: ClassVar[str]
    """What the scenario and the command line call it."""

    at_s: Seconds | None = None
    """Begin so many seconds after the start."""

    every_s: Interval | None = None
    """Begin again and again, so many seconds apart, at random up to half more or less."""

    times: Count | None = None
    """Over for good once it happened so many times."""

    @property
    def lasts_s(self) -> float | None:
        """How long it lasts once begun: 0 for a moment, None for until it is ended."""
        return 0.0

    def begin(self, run: Run) -> Callable[[], None] | None:
        """Do what is to be done at the beginning; return what is to be done at the end."""
        return None

    def __str__(self) -> str:
        return ",".join([self.kind, *_assignments(self.model_dump(exclude_unset=True))])


class ConnectionFault(Fault):
    """A fault of connections."""

    connection: Count | None = None
    """Only the n-th connection since the server's start; without it, all."""

    def covers(self, connection: ClientConnection) -> bool:
        """Return whether this connection is meant."""
        return self.connection in {None, connection.number}


class StrikeFault(ConnectionFault):
    """A fault that happens to connections in a moment."""

    def begin(self, run: Run) -> None:
        """Strike every connection that is meant."""
        for connection in list(run.simulator.connections):
            if self.covers(connection):
                self.strike(connection, run)

    def strike(self, connection: ClientConnection, run: Run) -> None:
        """Do it to one connection."""
        raise NotImplementedError


class LastingFault(Fault):
    """A fault that has an end."""

    for_s: Interval | None = None
    """Last so many seconds; without it, until the end."""

    @model_validator(mode="after")
    def _ends_before_it_begins_again(self) -> Self:
        if self.every_s is not None and self.for_s is None:
            raise validation_error("found every_s without for_s; expected both", "every_s")
        return self

    @property
    def lasts_s(self) -> float | None:
        """See Fault."""
        return self.for_s


class LineFault(ConnectionFault, LastingFault):
    """A fault of connections that lasts: it changes what passes through while it is on, new ones included.

    ``times`` counts what it changed: packets, replies or reads.
    """

    def outgoing(self, chunks: list[Chunk], run: Run) -> list[Chunk]:
        """Return what is to be sent instead of ``chunks``: one packet, as other faults may have left it."""
        return chunks

    def refusal(self, command: Packet) -> str | None:
        """Return why the server does not obey a client's packet, None if it does."""
        return None

    def replies(self, command: Packet, replies: list[bytes], line: Line) -> list[bytes]:
        """Return what is to be sent as the reply to ``command`` instead of ``replies``, each one packet."""
        return replies

    def reading_s(self, num_bytes: int) -> float:
        """Return how long the server takes to read so many bytes; infinity for until the fault ends."""
        return 0.0


def _assignments(values: dict[str, Any], prefix: str = "") -> list[str]:
    """Return NAME=VALUE for each value, those of mappings as MAPPING.NAME=VALUE."""
    texts: list[str] = []
    for name, value in values.items():
        if isinstance(value, dict):
            texts += _assignments(value, f"{prefix}{name}.")
        else:
            texts.append(f"{prefix}{name}={as_given(value)}")
    return texts


def as_given(value: object) -> str:
    """Return a parameter's value as the command line takes it."""
    match value:
        case bool():
            return "true" if value else "false"
        case float():
            return f"{value:.12g}"
        case tuple() | list():
            return f"[{','.join(map(as_given, value))}]"
    return str(value)
