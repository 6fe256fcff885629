"""Faults of the byte stream: split, merged, late or stopped."""

# ruff: noqa: ARG002 - hooks: not every kind needs every argument

import math
from typing import Annotated, ClassVar, Final

from pydantic import Field

from gateway.config.section import expects
from gateway.simulator.faults.base import ActiveFault, LastingConnectionFault
from gateway.simulator.faults.outgoing import PendingWrite
from gateway.simulator.faults.parameters import Milliseconds

Pieces = Annotated[int, Field(strict=True, ge=2, le=1000), expects("a whole number from 2 to 1000")]
Speed = Annotated[
    float,
    Field(strict=True, gt=0, le=1e9, allow_inf_nan=False),
    expects("a number of bytes per second above 0, up to 1e9"),
]


class Split(LastingConnectionFault):
    """The server sends each packet in several pieces of random size."""

    kind: ClassVar[str] = "split"

    pieces: Pieces = 3
    """The number of pieces; a packet of fewer bytes is sent byte by byte."""

    pause_ms: Milliseconds = 1.0
    """Milliseconds between two pieces."""

    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        """See LastingConnectionFault."""
        return [piece for write in writes for piece in self._split(write, active)]

    def _split(self, write: PendingWrite, active: ActiveFault) -> list[PendingWrite]:
        size = len(write.data)
        num_cuts = min(self.pieces, size) - 1
        cuts = sorted(active.rng.choice(size - 1, num_cuts, replace=False) + 1) if num_cuts > 0 else []
        pause_s = self.pause_ms / 1000
        return [
            write._replace(due_s=write.due_s + index * pause_s, data=write.data[start:stop])
            for index, (start, stop) in enumerate(zip([0, *cuts], [*cuts, size], strict=True))
        ]


class Merge(LastingConnectionFault):
    """The server collects packets and sends several at once."""

    kind: ClassVar[str] = "merge"

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

    kind: ClassVar[str] = "delay"

    delay_ms: Milliseconds = 100.0
    """The delay in milliseconds."""

    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        """See LastingConnectionFault."""
        return [write._replace(due_s=write.due_s + self.delay_ms / 1000) for write in writes]


class Jitter(LastingConnectionFault):
    """The server sends each packet late by a random time (exponential distribution), in order."""

    kind: ClassVar[str] = "jitter"

    mean_ms: Milliseconds = 5.0
    """The mean delay in milliseconds."""

    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        """See LastingConnectionFault."""
        delay_s = float(active.rng.exponential(self.mean_ms / 1000))
        return [write._replace(due_s=write.due_s + delay_s) for write in writes]


class HalfOpen(LastingConnectionFault):
    """The server neither reads nor writes nor closes connections; what it would have sent is lost."""

    kind: ClassVar[str] = "half_open"

    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        """See LastingConnectionFault."""
        return []

    def read_delay_s(self, num_bytes: int) -> float:
        """See LastingConnectionFault."""
        return math.inf


class SlowReader(LastingConnectionFault):
    """The server reads commands slowly."""

    kind: ClassVar[str] = "slow_reader"

    bytes_per_s: Speed = 100.0
    """The speed in bytes per second."""

    def read_delay_s(self, num_bytes: int) -> float:
        """See LastingConnectionFault."""
        return num_bytes / self.bytes_per_s


STREAM_FAULTS: Final[tuple[type[LastingConnectionFault], ...]] = (
    Split,
    Merge,
    Delay,
    Jitter,
    HalfOpen,
    SlowReader,
)
