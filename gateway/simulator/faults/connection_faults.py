"""Faults of a connection and of the server: split, merged, late, stopped or unexpected bytes, a restart."""

# ruff: noqa: ARG002 - hooks: not every kind needs every argument
import math
from typing import Annotated, Final

import numpy as np
from pydantic import Field

from gateway.config.section import expects
from gateway.rtc3d.packets import PACKET_HEADER, PacketType
from gateway.simulator.faults.base import (
    ActiveFault,
    Fault,
    LastingConnectionFault,
    LastingFault,
    Milliseconds,
    MomentaryFault,
    PendingWrite,
    Seconds,
)
from gateway.simulator.synthetic import Label, SceneSettings

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

    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        """See LastingConnectionFault."""
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

    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        """See LastingConnectionFault."""
        window_s = self.window_ms / 1000
        return [
            write._replace(due_s=math.ceil(write.due_s / window_s) * window_s, joins_previous=True)
            for write in writes
        ]


class Delay(LastingConnectionFault):
    """The server sends everything late."""

    delay_ms: Milliseconds = 100.0
    """The delay in milliseconds."""

    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        """See LastingConnectionFault."""
        return [write._replace(due_s=write.due_s + self.delay_ms / 1000) for write in writes]


class Jitter(LastingConnectionFault):
    """The server sends each packet late by a random time (exponential distribution), in order."""

    mean_ms: Milliseconds = 5.0
    """The mean delay in milliseconds."""

    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        """See LastingConnectionFault."""
        delay_s = float(active.rng.exponential(self.mean_ms / 1000))
        return [write._replace(due_s=write.due_s + delay_s) for write in writes]


class HalfOpen(LastingConnectionFault):
    """The server neither reads nor writes nor closes connections; what it would have sent is lost."""

    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        """See LastingConnectionFault."""
        return []

    def read_delay_s(self, num_bytes: int) -> float:
        """See LastingConnectionFault."""
        return math.inf


class SlowReader(LastingConnectionFault):
    """The server reads commands slowly."""

    bytes_per_s: Speed = 100.0
    """The speed in bytes per second."""

    def read_delay_s(self, num_bytes: int) -> float:
        """See LastingConnectionFault."""
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

    def data(self, rng: np.random.Generator) -> bytes:
        """See MomentaryFault."""
        return rng.bytes(self.num_bytes)


class _WrongSize(MomentaryFault):
    size_bytes: int

    def data(self, rng: np.random.Generator) -> bytes:
        """See MomentaryFault."""
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

    def data(self, rng: np.random.Generator) -> bytes:
        """See MomentaryFault."""
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

    @property
    def lasts_s(self) -> float | None:
        """See Fault."""
        return self.away_s


SERVER_FAULTS: Final = (NoMeasurement, ChangeScene, Rename, Restart)
"""What these do is in ``control.Faults``, which has the server."""
STREAM_FAULTS: Final = (Split, Merge, Delay, Jitter, HalfOpen, SlowReader)
MOMENTARY_FAULTS: Final = (Garbage, Oversize, Undersize, Cut)
