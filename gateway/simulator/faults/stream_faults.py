"""Faults of the byte stream: cut up, put together, late, spoilt, stopped."""

# ruff: noqa: ARG002 - hooks: not every kind needs every argument

from __future__ import annotations

import math
import socket
import struct
from typing import TYPE_CHECKING, Annotated, ClassVar, Final

from pydantic import Field

from gateway.config.section import expects
from gateway.rtc3d.packets import HEADER, PacketType
from gateway.simulator.faults.base import Chunk, ConnectionFault, LineFault, Milliseconds, Run, StrikeFault

if TYPE_CHECKING:
    from gateway.rtc3d_server.client_connection import ClientConnection

Pieces = Annotated[int, Field(strict=True, ge=2, le=1000), expects("a whole number from 2 to 1000")]
NumBytes = Annotated[int, Field(strict=True, ge=1, le=1_000_000), expects("a whole number from 1 to 1000000")]
TooLarge = Annotated[
    int, Field(strict=True, ge=9, le=0xFFFFFFFF), expects("a whole number of bytes from 9 to 4294967295")
]
TooSmall = Annotated[int, Field(strict=True, ge=0, le=7), expects("a whole number of bytes from 0 to 7")]
Speed = Annotated[
    float,
    Field(strict=True, gt=0, le=1e9, allow_inf_nan=False),
    expects("a number of bytes per second above 0, up to 1e9"),
]
Switch = Annotated[bool, Field(strict=True), expects("true or false")]

_HALF_PACKET: Final = HEADER.pack(1000, PacketType.DATA) + bytes(100)


class Split(LineFault):
    """Each packet is sent in several pieces of random size."""

    kind: ClassVar[str] = "split"

    pieces: Pieces = 3
    """How many; shorter packets in as many as they have bytes."""

    pause_ms: Milliseconds = 1.0
    """How long after one piece the next is sent, in ms."""

    def outgoing(self, chunks: list[Chunk], run: Run) -> list[Chunk]:
        """See LineFault."""
        return [piece for chunk in chunks for piece in self._split(chunk, run)]

    def _split(self, chunk: Chunk, run: Run) -> list[Chunk]:
        size = len(chunk.data)
        num_cuts = min(self.pieces, size) - 1
        cuts = sorted(run.rng.choice(size - 1, num_cuts, replace=False) + 1) if num_cuts > 0 else []
        pause_s = self.pause_ms / 1000
        return [
            chunk._replace(when_s=chunk.when_s + index * pause_s, data=chunk.data[start:stop])
            for index, (start, stop) in enumerate(zip([0, *cuts], [*cuts, size], strict=True))
        ]


class Merge(LineFault):
    """Packets are gathered and sent several at once."""

    kind: ClassVar[str] = "merge"

    window_ms: Milliseconds = 20.0
    """One send for what comes within so long, in ms."""

    def outgoing(self, chunks: list[Chunk], run: Run) -> list[Chunk]:
        """See LineFault."""
        window_s = self.window_ms / 1000
        return [
            chunk._replace(when_s=math.ceil(chunk.when_s / window_s) * window_s, joins=True)
            for chunk in chunks
        ]


class Delay(LineFault):
    """Everything is sent late."""

    kind: ClassVar[str] = "delay"

    delay_ms: Milliseconds = 100.0
    """How late, in ms."""

    def outgoing(self, chunks: list[Chunk], run: Run) -> list[Chunk]:
        """See LineFault."""
        return [chunk._replace(when_s=chunk.when_s + self.delay_ms / 1000) for chunk in chunks]


class Jitter(LineFault):
    """Each packet is late by a random time (exponential distribution), the order kept."""

    kind: ClassVar[str] = "jitter"

    mean_ms: Milliseconds = 5.0
    """How late on average, in ms."""

    def outgoing(self, chunks: list[Chunk], run: Run) -> list[Chunk]:
        """See LineFault."""
        late_s = float(run.rng.exponential(self.mean_ms / 1000))
        return [chunk._replace(when_s=chunk.when_s + late_s) for chunk in chunks]


class HalfOpen(LineFault):
    """The server neither reads nor writes, and does not close; what it would have sent is lost."""

    kind: ClassVar[str] = "half_open"

    def outgoing(self, chunks: list[Chunk], run: Run) -> list[Chunk]:
        """See LineFault."""
        return []

    def reading_s(self, num_bytes: int) -> float:
        """See LineFault."""
        return math.inf


class SlowReader(LineFault):
    """The server reads commands slowly."""

    kind: ClassVar[str] = "slow_reader"

    bytes_per_s: Speed = 100.0
    """How fast."""

    def reading_s(self, num_bytes: int) -> float:
        """See LineFault."""
        return num_bytes / self.bytes_per_s


class Garbage(StrikeFault):
    """Random bytes are sent between two packets."""

    kind: ClassVar[str] = "garbage"

    num_bytes: NumBytes = 64
    """How many."""

    def strike(self, connection: ClientConnection, run: Run) -> None:
        """See StrikeFault."""
        _inject(connection, run.rng.bytes(self.num_bytes))


class Oversize(StrikeFault):
    """A packet's header announces more bytes than follow."""

    kind: ClassVar[str] = "oversize"

    size_bytes: TooLarge = 0xFFFFFFFF
    """What its size field says."""

    def strike(self, connection: ClientConnection, run: Run) -> None:
        """See StrikeFault."""
        _inject(connection, HEADER.pack(self.size_bytes, PacketType.DATA))


class Undersize(StrikeFault):
    """A packet's header announces fewer bytes than the header has."""

    kind: ClassVar[str] = "undersize"

    size_bytes: TooSmall = 0
    """What its size field says."""

    def strike(self, connection: ClientConnection, run: Run) -> None:
        """See StrikeFault."""
        _inject(connection, HEADER.pack(self.size_bytes, PacketType.DATA))


class Cut(StrikeFault):
    """Connections end within a packet."""

    kind: ClassVar[str] = "cut"

    reset: Switch = False
    """Whether by RST, as when the server's computer forgets the connection, instead of FIN."""

    def strike(self, connection: ClientConnection, run: Run) -> None:
        """See StrikeFault."""
        connection.write(_HALF_PACKET)
        if self.reset:
            tcp = connection.transport.get_extra_info("socket")
            tcp.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            connection.transport.abort()
        else:
            connection.transport.close()


STREAM_FAULTS: Final[tuple[type[ConnectionFault], ...]] = (
    Split,
    Merge,
    Delay,
    Jitter,
    HalfOpen,
    SlowReader,
    Garbage,
    Oversize,
    Undersize,
    Cut,
)


def _inject(connection: ClientConnection, data: bytes) -> None:
    """Send bytes after all that waits, as they are."""
    if connection.line is None:
        connection.write(data)
    else:
        connection.line.inject(data)
