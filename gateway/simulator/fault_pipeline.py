"""Passes one connection's bytes through the faults that are active."""

import asyncio
import logging
import math
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

from gateway.rtc3d.packets import Packet, PacketType
from gateway.session.server.client_connection import ClientConnection, ConnectionFilter
from gateway.session.server.client_session import error_packet
from gateway.session.server.measurement import call_after_us
from gateway.simulator.faults import ActiveFault, LastingConnectionFault, PendingWrite, Reply, packet_type_of

MAX_WAITING_BYTES: Final = 4 * 1024 * 1024
"""How many bytes may wait to be sent on one connection; beyond this, packets are dropped."""

_log = logging.getLogger(__name__)


class WriteQueue:
    """Writes to a connection in order, each write when it is due."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._waiting: deque[PendingWrite] = deque()
        self._timer: asyncio.TimerHandle | None = None
        self._was_full = False
        self.waiting_bytes = 0
        """The total size of the waiting writes."""

    def put(self, writes: list[PendingWrite]) -> None:
        """Write what is due and keep the rest. If that exceeds MAX_WAITING_BYTES, drop ``writes``."""
        size = sum(len(write.data) for write in writes)
        if self._waiting and self.waiting_bytes + size > MAX_WAITING_BYTES:
            if not self._was_full:
                _log.warning(
                    "%s: faults delay more than %d MiB; dropping packets",
                    self._connection.name,
                    MAX_WAITING_BYTES >> 20,
                )
            self._was_full = True
            return
        self._waiting.extend(writes)
        self.waiting_bytes += size
        self.write_due(time.monotonic())

    def clear(self) -> None:
        """Discard everything."""
        self._cancel_timer()
        self._waiting.clear()
        self.waiting_bytes = 0

    def write_due(self, now_s: float) -> None:
        """Write what is due at this time; at math.inf, that is everything."""
        while self._waiting and self._waiting[0].due_s <= now_s:
            data = self._waiting.popleft().data
            while self._waiting and self._waiting[0].joins_previous and self._waiting[0].due_s <= now_s:
                data += self._waiting.popleft().data
            self.waiting_bytes -= len(data)
            self._connection.write(data)
        self._cancel_timer()
        if self._waiting:
            self._timer = call_after_us(
                1_000_000 * (self._waiting[0].due_s - now_s), lambda: self.write_due(time.monotonic())
            )

    def _cancel_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


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

    def hold(self, reply: Reply) -> bool:
        """Hold a reply for its ``delay_s`` or its ``after_frames``; return False if it has neither."""
        if not (reply.delay_s or reply.after_frames):
            return False
        held = _HeldReply(reply.packet, reply.after_frames)
        if not reply.after_frames:
            held.timer = asyncio.get_running_loop().call_later(reply.delay_s, self._release, held)
        self._held.append(held)
        return True

    def packet_sent(self, packet: bytes) -> None:
        """Send the replies that waited for this packet, if it is a data frame or No Data."""
        packet_type = packet_type_of(packet)
        if packet_type not in {PacketType.DATA, PacketType.NO_DATA}:
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


ActiveConnectionFaults = list[tuple[ActiveFault, LastingConnectionFault]]
"""Pairs of an active fault and its ``fault``, in the order in which they act."""


class FaultPipeline(ConnectionFilter):
    """The filter of one connection: its bytes pass through the active faults in both directions.

    Packets keep their order, even if faults delay them. ``active_faults`` returns the faults that are
    active on the connection with a given number; ``count`` is called with those that changed something.
    """

    def __init__(
        self,
        connection: ClientConnection,
        active_faults: Callable[[int], ActiveConnectionFaults],
        count: Callable[[Iterable[ActiveFault]], None],
    ) -> None:
        super().__init__(connection)
        self._active_faults = active_faults
        self._count = count
        self._writes = WriteQueue(connection)
        self._held_replies = HeldReplies(self.send)
        self._unread = bytearray()
        self._read_timer: asyncio.TimerHandle | None = None

    @property
    def waiting_bytes(self) -> int:
        """The number of bytes that faults hold back, in both directions."""
        return self._writes.waiting_bytes + self._held_replies.waiting_bytes + len(self._unread)

    # For the connection ---------------------------------------------------------------------

    def send(self, packet: bytes) -> None:
        """Send one packet with the changes of the active faults."""
        active_faults = self._active_faults(self.connection.number)
        changed_by = []
        if not active_faults and not self._writes.waiting_bytes:
            self.connection.write(packet)
        else:
            writes = [PendingWrite(time.monotonic(), packet)]
            for active, fault in active_faults:
                changed = fault.change_writes(writes, active)
                if changed != writes:
                    changed_by.append(active)
                writes = changed
            self._writes.put(writes)
        self._held_replies.packet_sent(packet)
        self._count(changed_by)

    def answer(self, packet: Packet) -> list[bytes]:
        """Return the replies to a client's packet with the changes of the active faults."""
        active_faults = self._active_faults(self.connection.number)
        for active, fault in active_faults:
            refusal = fault.refusal(packet)
            if refusal is not None:
                self._count([active])
                return [error_packet(refusal)]
        changed_by = []
        replies = [Reply(reply) for reply in self.connection.answer(packet)]
        for active, fault in active_faults:
            changed = fault.change_replies(packet, replies)
            if changed != replies:
                changed_by.append(active)
            replies = [reply for reply in changed if not self._held_replies.hold(reply)]
        self._count(changed_by)
        return [reply.packet for reply in replies]

    def receive(self, data: bytes) -> None:
        """Process bytes from the client, or keep them and stop reading if a fault delays them."""
        delays_s = [
            (active, fault.read_delay_s(len(data)))
            for active, fault in self._active_faults(self.connection.number)
        ]
        delay_s = max((delay_s for _, delay_s in delays_s), default=0.0)
        if not delay_s and not self._unread:
            self.connection.handle(data)
            return
        self._unread += data
        self.connection.transport.pause_reading()
        if self._read_timer is None and math.isfinite(delay_s):
            self._read_timer = asyncio.get_running_loop().call_later(delay_s, self.handle_unread)
        self._count([active for active, its_delay_s in delays_s if its_delay_s])

    def flush(self) -> None:
        """Send at once all bytes that faults hold back, in order."""
        self._held_replies.flush()
        self._writes.write_due(math.inf)

    def connection_lost(self) -> None:
        """Discard all bytes that faults hold back, in both directions."""
        if self._read_timer is not None:
            self._read_timer.cancel()
        self._writes.clear()
        self._held_replies.clear()
        self._unread.clear()

    # For faults -----------------------------------------------------------------------------

    def send_unchanged(self, data: bytes) -> None:
        """Send bytes that no fault changes, after all bytes that are waiting."""
        self._writes.put([PendingWrite(time.monotonic(), data)])

    def disconnect(self, last_data: bytes, *, reset: bool) -> None:
        """Write ``last_data`` before all bytes that are waiting, and end the connection with FIN or RST."""
        self.connection.write(last_data)
        if reset:
            tcp = self.connection.transport.get_extra_info("socket")
            tcp.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self.connection.transport.abort()
        else:
            self.connection.transport.close()

    def handle_unread(self) -> None:
        """Process at once the bytes whose reading a fault delayed."""
        if self._read_timer is not None:
            self._read_timer.cancel()
            self._read_timer = None
        if self._unread:
            data = bytes(self._unread)
            self._unread.clear()
            self.connection.resume_reading()
            self.connection.handle(data)

    def fault_ended(self) -> None:
        """Process the bytes that are unread only because of the fault that has just ended."""
        is_reading_stopped = any(
            math.isinf(fault.read_delay_s(len(self._unread)))
            for _, fault in self._active_faults(self.connection.number)
        )
        if self._unread and self._read_timer is None and not is_reading_stopped:
            self.handle_unread()
