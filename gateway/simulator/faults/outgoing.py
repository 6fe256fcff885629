"""What the server is about to send, in the form in which faults change it."""

from typing import NamedTuple

from gateway.rtc3d.packets import PacketType


class PendingWrite(NamedTuple):
    """Bytes to write to a client's socket; before any fault changes it, one packet."""

    due_s: float
    """When to write them, in s on the monotonic clock; later if earlier writes are due later."""

    data: bytes

    joins_previous: bool = False
    """Whether one send covers these bytes and those before them, if both are due."""


class Reply(NamedTuple):
    """A reply to a command, one packet; it leaves at once unless a delay is given."""

    packet: bytes

    delay_s: float = 0.0
    """How much later it leaves; everything else overtakes it."""

    after_frames: int = 0
    """The number of data frames that leave before it; a No Data packet ends the wait."""

    @property
    def is_held(self) -> bool:
        """Whether the reply leaves later than its turn."""
        return bool(self.delay_s or self.after_frames)


def packet_type_of(packet: bytes) -> int:
    """Return a packet's type (§4.2); -1 for bytes that are no packet."""
    return int.from_bytes(packet[4:8], "big") if len(packet) >= 8 else -1


def is_acknowledgement(packet: bytes) -> bool:
    """Return whether a reply reports success: type 1, whatever its text (field note 1)."""
    return packet_type_of(packet) == PacketType.COMMAND
