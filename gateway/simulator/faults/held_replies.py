"""Replies to one client that are sent late, after other packets."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass

from gateway.rtc3d.packets import PacketType
from gateway.simulator.faults.outgoing import Reply, packet_type_of


@dataclass(slots=True, eq=False)
class _HeldReply:
    packet: bytes
    num_frames: int  # data frames to send before it; 0 if it waits for its timer
    timer: asyncio.TimerHandle | None = None


class HeldReplies:
    """Holds replies until their delay is over or enough frames have been sent, then sends them."""

    def __init__(self, send: Callable[[bytes], None]) -> None:
        self._send = send
        self._held: list[_HeldReply] = []

    @property
    def waiting_bytes(self) -> int:
        """The size of all replies that are held."""
        return sum(len(held.packet) for held in self._held)

    def hold(self, reply: Reply) -> None:
        """Hold a reply for its ``delay_s`` or its ``after_frames``."""
        held = _HeldReply(reply.packet, reply.after_frames)
        if not reply.after_frames:
            held.timer = asyncio.get_running_loop().call_later(reply.delay_s, self._release, held)
        self._held.append(held)

    def packet_sent(self, packet: bytes) -> None:
        """Send the replies that waited for this packet, if it is a data frame or No Data."""
        packet_type = packet_type_of(packet)
        if not self._held or packet_type not in {PacketType.DATA, PacketType.NO_DATA}:
            return
        for held in [held for held in self._held if held.num_frames]:
            if held.num_frames > 1 and packet_type == PacketType.DATA:
                held.num_frames -= 1
            else:
                self._release(held)

    def flush(self) -> None:
        """Send all replies at once, in the order of their commands."""
        for held in list(self._held):
            self._release(held)

    def clear(self) -> None:
        """Discard all replies."""
        for held in self._held:
            if held.timer is not None:
                held.timer.cancel()
        self._held.clear()

    def _release(self, held: _HeldReply) -> None:
        if held not in self._held:
            return  # sending another reply has already released it
        self._held.remove(held)
        if held.timer is not None:
            held.timer.cancel()
        self._send(held.packet)
