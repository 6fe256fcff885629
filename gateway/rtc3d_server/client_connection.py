"""One client's TCP connection, and how much it may use up."""

import asyncio
import logging
import time
from collections import Counter, deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, cast

import gateway
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import Packet, PacketReader, PacketType
from gateway.rtc3d.parameters import General
from gateway.rtc3d_server.client_session import ClientSession, SessionCallbacks, error_packet
from gateway.rtc3d_server.connection_filter import ConnectionFilter
from gateway.server_limits import ServerLimits
from gateway.token_bucket import TokenBucket

if TYPE_CHECKING:
    from gateway.rtc3d_server.server import RtServer

MAX_COMMAND_BYTES: Final = 64 * 1024
"""The largest packet that a client may send."""

LIMITS: Final = ServerLimits(
    clients=128, handshake_s=10.0, unread_bytes=4 * 1024 * 1024, unread_s=300.0, close_s=1.0
)
"""4 MiB are a second of the largest streams. A person may type the first command, or debug a client.

Only servers of live sources bound the number of clients, because the simulator is for one's own programs.
"""

MAX_COMMANDS_PER_S: Final = 1000.0
"""How many packets of one client are answered in a second; further ones wait."""

_COMMANDS_PAUSE_S: Final = 0.05  # for a client that sends too many
_MAX_LOGGED_BYTES: Final = 200  # of a command
_log = logging.getLogger(__name__)


class SentCounts:
    """Counts data frames and the components in them."""

    def __init__(self) -> None:
        self._frames: Counter[tuple[ComponentType, ...]] = Counter()

    def add(self, components: tuple[ComponentType, ...]) -> None:
        """Count one frame with these components."""
        self._frames[components] += 1

    @property
    def frames(self) -> int:
        """The number of frames."""
        return self._frames.total()

    @property
    def components(self) -> Counter[str]:
        """How often each component was in a frame, by its key."""
        counts: Counter[str] = Counter()
        for components, frames in self._frames.items():
            counts.update({component.key: frames for component in components})
        return counts


class ClientConnection(asyncio.BufferedProtocol):
    """One client's TCP connection: passes packets to its session, and sends replies and due frames.

    Nagle's algorithm is off (§2.1): asyncio and uvloop switch it off for every TCP connection. Each
    packet is written at once and by itself, because common clients read a packet with one recv
    (field note 15). While a client does not read, the server drops its frames and does not read from
    it either. Nor does it read from a client that sends commands faster than they are answered. If a client
    closes only its sending half, it gets the replies and the current frames that it has asked for.
    """

    transport: asyncio.Transport
    filter: ConnectionFilter
    """Passes all bytes in both directions, and may change them."""

    number: int
    """The connection's number since the server's start, from 1."""

    def __init__(self, owner: "RtServer") -> None:
        self._owner = owner
        self._loop = asyncio.get_running_loop()
        self._reader = PacketReader(max_packet_bytes=MAX_COMMAND_BYTES, max_c3d_bytes=MAX_COMMAND_BYTES)
        # The next bytes are read when all packets in these are answered, so that little waits in memory.
        self._read_buffer = bytearray(LIMITS.read_bytes)
        self._inbox: deque[Packet] = deque()
        self._commands = TokenBucket(MAX_COMMANDS_PER_S)
        self._is_processing = False  # whether _process_inbox is to be called
        self._is_held = False  # whether the packets in _inbox wait for the answer to the one before
        self._is_full = False  # whether as many bytes as may wait for the client to read
        self._was_full = False  # whether it has been full before
        self._has_ended = False  # whether the client has closed its sending half
        self._recording_end: asyncio.TimerHandle | None = None  # of a recording that has a duration
        self._first_sent_s: float | None = None  # when the first frame was sent, on the monotonic clock
        self._last_sent_s = 0.0  # when the newest frame was sent
        self.closed: asyncio.Future[None] = self._loop.create_future()
        """Done once the connection has ended."""
        self.sent_counts = SentCounts()
        """What was sent to this client."""
        self.session = ClientSession(
            SessionCallbacks(owner.frames, self._parameters_xml, owner.frames_requested, self._record_for)
        )

    @property
    def name(self) -> str:
        """The client's address and port."""
        return self.session.name

    @property
    def due_us(self) -> int | None:
        """When the next frame is due, in µs since the measurement's start; None if none is to be sent."""
        return self.session.due_us if self._can_send() else None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """See asyncio.Protocol."""
        self.transport = cast(asyncio.Transport, transport)
        self.transport.set_write_buffer_limits(high=self._owner.limits.unread_bytes_each)
        peer = transport.get_extra_info("peername")
        if peer is not None:  # the client has not reset the connection already
            address, port = peer[:2]
            self.session.name = f"[{address}]:{port}" if ":" in address else f"{address}:{port}"
        self.filter = self._owner.new_filter(self)
        self.number = self._owner.connection_opened(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """See asyncio.Protocol."""
        self._inbox.clear()
        self._record_for(None)
        self.filter.connection_lost()
        self._owner.connection_closed(self, exc)
        self.closed.set_result(None)

    def pause_writing(self) -> None:
        """Stop sending and reading: the client does not read (asyncio.Protocol)."""
        self._is_full = True
        self.transport.pause_reading()
        self._owner.reading_stopped(self, is_first=not self._was_full)
        self._was_full = True

    def resume_writing(self) -> None:
        """Send and read again: the client reads (asyncio.Protocol)."""
        self._is_full = False
        elapsed_us = self._owner.elapsed_us()
        if elapsed_us is not None:
            self.session.drop_due_frames(elapsed_us)
        self._owner.reading_resumed(self)
        self.resume_reading()
        self._owner.schedule()
        self._process_soon()

    def resume_reading(self) -> None:
        """Read from the socket again, unless packets are waiting or the connection is closing."""
        if self._can_send() and not self._inbox:
            self.transport.resume_reading()

    def get_buffer(self, sizehint: int) -> bytearray:  # noqa: ARG002 - the size is bounded
        """See asyncio.BufferedProtocol."""
        return self._read_buffer

    def buffer_updated(self, nbytes: int) -> None:
        """See asyncio.BufferedProtocol."""
        self.filter.receive(bytes(self._read_buffer[:nbytes]))

    def eof_received(self) -> bool:
        """Close the connection, unless the client still waits for something (asyncio.BufferedProtocol)."""
        self._has_ended = True
        return self._owes_answers or self.filter.is_busy

    def handle(self, data: bytes) -> None:
        """Read packets from the next bytes of the client, and answer them."""
        self._inbox.extend(self._reader.feed(data))
        if not self._is_processing:
            self._process_inbox()
        if self._inbox and not self.transport.is_closing():
            self.transport.pause_reading()

    def hold_commands(self) -> None:
        """Answer no further packets until ``continue_commands``."""
        self._is_held = True

    def continue_commands(self) -> None:
        """Answer packets again."""
        self._is_held = False
        self._process_soon()

    def answer(self, packet: Packet) -> list[bytes]:
        """Execute a client's packet; return the replies, each one packet."""
        return self.session.answer(packet)

    def send_due_frames(self, elapsed_us: int) -> None:
        """Send the frames that are due, or drop them if the client does not read."""
        if not self._can_send():
            if not self.transport.is_closing():
                self.session.drop_due_frames(elapsed_us)
            return
        for packet, components, _ in self.session.due_frames(elapsed_us):
            self.send(packet)
            self.sent_counts.add(components)
            self._owner.sent_counts.add(components)
            self._last_sent_s = time.monotonic()
            if self._first_sent_s is None:
                self._first_sent_s = self._last_sent_s
            if not self._can_send():
                break
        self._close_if_ended()

    def measurement_stopped(self) -> None:
        """Send No Data for the stream and for each request that waits."""
        for packet in self.session.measurement_stopped():
            self.send(packet)
        self._close_if_ended()

    def send(self, packet: bytes) -> None:
        """Send one packet through the filter."""
        self.filter.send(packet)

    def write(self, data: bytes) -> None:
        """Write bytes to the socket with one send. All bytes to the client go through here."""
        if not self.transport.is_closing():
            self.transport.write(data)

    def close(self) -> None:
        """Close the connection once everything has been sent; ``closed`` is done then."""
        self._inbox.clear()
        self.filter.flush()
        self.transport.close()

    def continue_sending(self) -> None:
        """Send frames and replies again, because the filter is no longer busy."""
        elapsed_us = self._owner.elapsed_us()
        if elapsed_us is not None:
            self.session.drop_due_frames(elapsed_us)
        self.resume_reading()
        self._owner.schedule()
        self._process_soon()

    @property
    def _owes_answers(self) -> bool:
        return bool(self._inbox) or self._is_held or self.session.waits_for_frame

    def _close_if_ended(self) -> None:
        if self._has_ended and not self._owes_answers and self._can_send():
            self.close()

    def _can_send(self) -> bool:
        return not (self._is_full or self.filter.is_busy or self.transport.is_closing())

    def _process_soon(self, delay_s: float = 0.0) -> None:
        if not self._is_processing:
            self._is_processing = True
            if delay_s:
                self._loop.call_later(delay_s, self._process_next)
            else:
                self._loop.call_soon(self._process_next)

    def _process_next(self) -> None:
        self._is_processing = False
        self._process_inbox()

    def _process_inbox(self) -> None:
        """Answer one packet. The next one waits for the loop's next turn, so no client delays the others."""
        if self._is_held or not self._can_send():
            return
        if self._inbox:
            if not self._commands.try_take():
                self._process_soon(_COMMANDS_PAUSE_S)
                return
            packet = self._inbox.popleft()
            _log.debug("%s: received %s", self.name, _described(packet))
            for reply in self.filter.answer(packet):
                self.send(reply)
            if self.session.said_bye:
                self.close()
                return
            elapsed_us = self._owner.elapsed_us()
            if elapsed_us is not None:
                self.send_due_frames(elapsed_us)
            self._owner.schedule()
        if self._inbox:
            self._process_soon()
            return
        self.resume_reading()
        if self._reader.error is not None and not self._is_held:
            size = self._reader.error.size
            self.send(
                error_packet(f"A packet of {size} bytes is out of bounds (8 to {MAX_COMMAND_BYTES}); closing")
            )
            self.close()
        self._close_if_ended()

    def _record_for(self, duration_s: float | None) -> None:
        """See SessionCallbacks."""
        if self._recording_end is not None:
            self._recording_end.cancel()
            self._recording_end = None
        if duration_s is not None:
            self._recording_end = self._loop.call_later(duration_s, self.session.end_recording)

    def _parameters_xml(self, sections: Sequence[str]) -> bytes:
        address, port = self.transport.get_extra_info("sockname")[:2]
        frames = self.sent_counts.frames
        streaming_s = 0.0 if self._first_sent_s is None else self._last_sent_s - self._first_sent_s
        general = General(
            name=self._owner.name,
            version=gateway.__version__,
            address=address,
            port=port,
            frames_sent=frames,
            frames_per_s=round((frames - 1) / streaming_s, 2) if streaming_s > 0 else 0.0,
        )
        return self._owner.scene.parameters_xml(sections, general)


def _described(packet: Packet) -> str:
    """Return a client's packet as text for the log: a command as it was sent, bytes after it included."""
    if packet.type == PacketType.COMMAND:
        return ascii(packet.body[:_MAX_LOGGED_BYTES].decode("latin-1"))
    return f"a packet of type {packet.type} with {len(packet.body)} bytes"
