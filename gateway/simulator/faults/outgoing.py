"""Writes and replies that the server is about to send, as faults receive and change them."""

from typing import NamedTuple

from gateway.rtc3d.packets import PacketType


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
