"""Faults that happen to connections at one moment: unexpected bytes, and the end of a connection."""

from typing import Annotated, ClassVar, Final

from pydantic import Field

from gateway.config.section import expects
from gateway.rtc3d.packets import PACKET_HEADER, PacketType
from gateway.simulator.faults.base import ActiveFault, MomentaryFault
from gateway.simulator.faults.faulty_server import FaultyConnection

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

    def act_on(self, connection: FaultyConnection, active: ActiveFault) -> None:  # noqa: ARG002 - see MomentaryFault
        """See MomentaryFault."""
        connection.send_unchanged(PACKET_HEADER.pack(self.size_bytes, PacketType.DATA))


class Undersize(MomentaryFault):
    """The server sends a packet header that announces fewer bytes than the header itself has."""

    kind: ClassVar[str] = "undersize"

    size_bytes: TooSmall = 0
    """The value of the size field."""

    def act_on(self, connection: FaultyConnection, active: ActiveFault) -> None:  # noqa: ARG002 - see MomentaryFault
        """See MomentaryFault."""
        connection.send_unchanged(PACKET_HEADER.pack(self.size_bytes, PacketType.DATA))


class Cut(MomentaryFault):
    """Connections end in the middle of a packet."""

    kind: ClassVar[str] = "cut"

    reset: Switch = False
    """End connections with RST instead of FIN, as a server's computer does after a restart."""

    def act_on(self, connection: FaultyConnection, active: ActiveFault) -> None:  # noqa: ARG002 - see MomentaryFault
        """See MomentaryFault."""
        connection.disconnect(_PART_OF_A_PACKET, reset=self.reset)


MOMENTARY_FAULTS: Final[tuple[type[MomentaryFault], ...]] = (Garbage, Oversize, Undersize, Cut)
