"""Faults of a connection and of the server: split, merged, late, stopped or unexpected bytes, a restart."""

# ruff: noqa: ARG002 - hooks: not every kind needs every argument
import math
from collections.abc import Callable
from typing import Annotated, ClassVar, Final

from pydantic import Field

from gateway.config.section import expects
from gateway.rtc3d.packets import PACKET_HEADER, PacketType
from gateway.simulator.faults.base import (
    ActiveFault,
    Fault,
    FaultyConnection,
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


NumBytes = Annotated[int, Field(strict=True, ge=1, le=1_000_000), expects("a whole number from 1 to 1000000")]
TooLarge = Annotated[
    int, Field(strict=True, ge=9, le=0xFFFFFFFF), expects("a whole number of bytes from 9 to 4294967295")
]
TooSmall = Annotated[int, Field(strict=True, ge=0, le=7), expects("a whole number of bytes from 0 to 7")]
Switch = Annotated[bool, Field(strict=True), expects("true or false")]

_PART_OF_A_PACKET: Final = PACKET_HEADER.pack(1000, PacketType.DATA) + bytes(100)


class Garbage(MomentaryFault):
    """The server sends random bytes between two packets."""

    kind: ClassVar[str] = "garbage"

    num_bytes: NumBytes = 64
    """The number of bytes."""

    def act_on(self, connection: FaultyConnection, active: ActiveFault) -> None:
        """See MomentaryFault."""
        connection.send_unchanged(active.rng.bytes(self.num_bytes))


class Oversize(MomentaryFault):
    """The server sends a packet header that announces more bytes than follow."""

    kind: ClassVar[str] = "oversize"

    size_bytes: TooLarge = 0xFFFFFFFF
    """The value of the size field."""

    def act_on(self, connection: FaultyConnection, active: ActiveFault) -> None:
        """See MomentaryFault."""
        connection.send_unchanged(PACKET_HEADER.pack(self.size_bytes, PacketType.DATA))


class Undersize(MomentaryFault):
    """The server sends a packet header that announces fewer bytes than the header itself has."""

    kind: ClassVar[str] = "undersize"

    size_bytes: TooSmall = 0
    """The value of the size field."""

    def act_on(self, connection: FaultyConnection, active: ActiveFault) -> None:
        """See MomentaryFault."""
        connection.send_unchanged(PACKET_HEADER.pack(self.size_bytes, PacketType.DATA))


class Cut(MomentaryFault):
    """Connections end in the middle of a packet."""

    kind: ClassVar[str] = "cut"

    reset: Switch = False
    """End connections with RST instead of FIN, as a server's computer does after a restart."""

    def act_on(self, connection: FaultyConnection, active: ActiveFault) -> None:
        """See MomentaryFault."""
        connection.disconnect(_PART_OF_A_PACKET, reset=self.reset)


MOMENTARY_FAULTS: Final[tuple[type[MomentaryFault], ...]] = (Garbage, Oversize, Undersize, Cut)


class NoMeasurement(LastingFault):
    """The measurement stops; when the fault ends, a new one starts."""

    kind: ClassVar[str] = "no_measurement"

    def begin(self, active: ActiveFault) -> Callable[[], None]:
        """See Fault."""
        active.server.stop_measurement()
        return active.server.start_measurement


class ChangeScene(LastingFault):
    """Markers, tools and so on change during the measurement; when the fault ends, they change back."""

    kind: ClassVar[str] = "change_scene"

    scene: SceneSettings = SceneSettings(markers=12)
    """The changes to the scenario's scene; by default, it gets 12 markers."""

    def begin(self, active: ActiveFault) -> Callable[[], None]:
        """See Fault."""
        return active.server.change_scene(self.scene)


class Rename(LastingFault):
    """Somebody renames all markers and tools; when the fault ends, they have their former names."""

    kind: ClassVar[str] = "rename"

    prefix: Label = "New "
    """The text before each former name."""

    def begin(self, active: ActiveFault) -> Callable[[], None]:
        """See Fault."""
        return active.server.rename_items(self.prefix)


class Restart(Fault):
    """The server crashes and comes back on the same port with a new measurement."""

    kind: ClassVar[str] = "restart"

    away_s: Seconds = 1.0
    """Seconds until the server comes back."""

    scene: SceneSettings = SceneSettings()
    """The changes to the scenario's scene; by default, none."""

    @property
    def lasts_s(self) -> float | None:
        """See Fault."""
        return self.away_s

    def begin(self, active: ActiveFault) -> Callable[[], None]:
        """See Fault."""
        active.server.crash()
        if self.scene.model_fields_set:
            active.server.change_scene(self.scene)
        return active.server.restart


SERVER_FAULTS: Final[tuple[type[Fault], ...]] = (NoMeasurement, ChangeScene, Rename, Restart)
