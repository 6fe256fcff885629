"""The TCP connections of a server's clients, what they share, and how much each may use up."""

import asyncio
import logging
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Final, cast

import gateway
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import Packet, PacketType
from gateway.rtc3d.parameters import General
from gateway.runtime.server_limits import ServerLimits
from gateway.session.server.client_session import ClientSession, error_packet
from gateway.session.server.command_queue import MAX_COMMAND_BYTES, CommandQueue
from gateway.session.server.measurement import Measurement
from gateway.session.server.scene import FrameSource

LIMITS: Final = ServerLimits(
    clients=128, handshake_s=10.0, unread_bytes=4 * 1024 * 1024, unread_s=300.0, close_s=1.0
)
"""4 MiB are a second of the largest streams. A person may type the first command, or debug a client.

Only servers of live sources bound the number of clients, because the simulator is for one's own programs.
"""

_MAX_LOGGED_BYTES: Final = 200  # of a command
_log = logging.getLogger(__name__)


class ConnectionFilter:
    """Passes one connection's bytes through unchanged.

    Subclasses override methods to change, delay or drop them. They reach the socket and the server only
    through ``connection``.
    """

    is_busy: bool = False
    """Whether no frame and no reply may be sent now. Frames are dropped, commands wait."""

    def __init__(self, connection: "ClientConnection") -> None:
        self.connection = connection

    def send(self, packet: bytes) -> None:
        """Send one packet (a reply or a data frame) to the client."""
        self.connection.write(packet)

    def receive(self, data: bytes) -> None:
        """Process bytes that were read from the client's socket."""
        self.connection.handle(data)

    def answer(self, packet: Packet) -> list[bytes]:
        """Return the replies to a client's packet; each of them then goes through ``send``."""
        return self.connection.answer(packet)

    def flush(self) -> None:
        """Write at once all bytes that the filter holds back: the server is about to close the connection."""

    def connection_lost(self) -> None:
        """Discard all bytes that the filter holds back, and cancel its timers: the connection has ended."""


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

    def __init__(self, owner: "ConnectionOwner") -> None:
        self._owner = owner
        # The next bytes are read when all packets in these are answered, so that little waits in memory.
        self._read_buffer = bytearray(LIMITS.read_bytes)
        self._commands = CommandQueue(self._answer_next)
        self._is_full = False  # whether as many bytes as may wait for the client to read
        self._was_full = False  # whether it has been full before
        self._has_ended = False  # whether the client has closed its sending half
        self._recording_end: asyncio.TimerHandle | None = None  # of a recording that has a duration
        self.closed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Done once the connection has ended."""
        self.sent = SentFrames()
        self.session = ClientSession(self)

    @property
    def name(self) -> str:
        """The client's address and port, for log messages."""
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
        self.record_for(None)
        self.filter.connection_lost()
        self._commands.packets.clear()
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
        self.continue_sending()
        self._owner.reading_resumed(self)

    def resume_reading(self) -> None:
        """Read from the socket again, unless packets are waiting or the connection is closing."""
        if self._can_send() and not self._commands.packets:
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

    # For the filter -------------------------------------------------------------------------

    def handle(self, data: bytes) -> None:
        """Process bytes from the client, bypassing the filter; the replies go through it."""
        self._commands.feed(data)
        if not self._commands.is_scheduled:
            self._answer_next()
        if self._commands.packets and not self.transport.is_closing():
            self.transport.pause_reading()

    def answer(self, packet: Packet) -> list[bytes]:
        """Execute a client's packet; return the replies, each one packet."""
        return self.session.answer(packet)

    def write(self, data: bytes) -> None:
        """Write bytes to the socket with one send. All bytes to the client go through here."""
        if not self.transport.is_closing():
            self.transport.write(data)

    def hold_commands(self) -> None:
        """Answer no further packets until ``continue_commands``."""
        self._commands.is_held = True

    @property
    def waiting(self) -> Sequence[Packet]:
        """The packets that wait for an answer to those before them."""
        return self._commands.packets

    def continue_commands(self) -> None:
        """Answer packets again."""
        self._commands.is_held = False
        self._commands.schedule()

    def continue_sending(self) -> None:
        """Send frames and replies again after ``is_busy``; the frames in between are dropped."""
        if (elapsed_us := self._owner.elapsed_us()) is not None:
            self.session.drop_due_frames(elapsed_us)
        self.resume_reading()
        self._owner.schedule()
        self._commands.schedule()

    # For the server -------------------------------------------------------------------------

    def send_due_frames(self, elapsed_us: int) -> None:
        """Send the frames that are due, or drop them if the client does not read."""
        if not self._can_send():
            if not self.transport.is_closing():
                self.session.drop_due_frames(elapsed_us)
            return
        for packet, components, _ in self.session.due_frames(elapsed_us):
            self.filter.send(packet)
            self.sent.add()
            self._owner.sent[components] += 1
            if not self._can_send():
                break
        self._close_if_ended()

    def measurement_stopped(self) -> None:
        """Send No Data for the stream and for each request that waits."""
        for packet in self.session.measurement_stopped():
            self.filter.send(packet)
        self._close_if_ended()

    def close(self) -> None:
        """Close the connection once everything has been sent; ``closed`` is done then."""
        self._commands.packets.clear()
        self.filter.flush()
        self.transport.close()

    @property
    def _owes_answers(self) -> bool:
        return bool(self._commands.packets) or self._commands.is_held or self.session.waits_for_frame

    def _close_if_ended(self) -> None:
        if self._has_ended and not self._owes_answers and self._can_send():
            self.close()

    def _can_send(self) -> bool:
        return not (self._is_full or self.filter.is_busy or self.transport.is_closing())

    def _answer_next(self) -> None:
        """Answer one packet, unless it has to wait. The next one waits for the loop's next turn."""
        commands = self._commands
        if commands.is_held or not self._can_send():
            return
        if commands.packets:
            packet = commands.take()
            if packet is None:
                return
            _log.debug("%s: received %s", self.name, _described(packet))
            for reply in self.filter.answer(packet):
                self.filter.send(reply)
            if self.session.said_bye:
                self.close()
                return
            if (elapsed_us := self._owner.elapsed_us()) is not None:
                self.send_due_frames(elapsed_us)
            self._owner.schedule()
        if commands.packets:
            commands.schedule()
            return
        self.resume_reading()
        if commands.bad_size is not None and not commands.is_held:
            size = commands.bad_size
            text = f"A packet of {size} bytes is out of bounds (8 to {MAX_COMMAND_BYTES}); closing"
            self.filter.send(error_packet(text))
            self.close()
        self._close_if_ended()

    # For the session (see SessionHost) ------------------------------------------------------

    def frames(self, components: Sequence[ComponentType]) -> FrameSource:
        """Return the frames with these components; an empty sequence means all."""
        return self._owner.frames(components)

    def parameters_xml(self, sections: Sequence[str]) -> bytes:
        """Return the XML of some sections, with the facts of this connection in General."""
        address, port = self.transport.get_extra_info("sockname")[:2]
        general = General(
            name=self._owner.name,
            version=gateway.__version__,
            address=address,
            port=port,
            frames_sent=self.sent.number,
            frames_per_s=self.sent.per_s,
        )
        return self._owner.parameters_xml(sections, general)

    def frames_requested(self) -> int | None:
        """Note that the client requests frames; return the measurement's time in µs, None without one."""
        return self._owner.frames_requested()

    def record_for(self, duration_s: float | None) -> None:
        """End the client's recording after this time, or never if it is None."""
        if self._recording_end is not None:
            self._recording_end.cancel()
            self._recording_end = None
        if duration_s is not None:
            loop = asyncio.get_running_loop()
            self._recording_end = loop.call_later(duration_s, self.session.end_recording)


class SentFrames:
    """The frames that were sent to a client."""

    def __init__(self) -> None:
        self.number = 0
        """How many there were."""
        self._first_s = self._last_s = 0.0  # when they were sent, on the monotonic clock

    def add(self) -> None:
        """Count a frame that is sent now."""
        self.number += 1
        self._last_s = time.monotonic()
        self._first_s = self._first_s or self._last_s

    @property
    def per_s(self) -> float:
        """How many there were in a second from the first to the last, with two decimals."""
        streaming_s = self._last_s - self._first_s
        return round((self.number - 1) / streaming_s, 2) if streaming_s > 0 else 0.0


def _described(packet: Packet) -> str:
    """Return a client's packet as text for the log: a command as it was sent, bytes after it included."""
    if packet.type == PacketType.COMMAND:
        return ascii(packet.body[:_MAX_LOGGED_BYTES].decode("latin-1"))
    return f"a packet of type {packet.type} with {len(packet.body)} bytes"


class ConnectionOwner(ABC):
    """What the connections of one server share: the measurement, limits, and what becomes of each connection.

    RtServer, which adds the port and the timer, describes the arguments.
    """

    def __init__(
        self,
        measurement: Measurement,
        name: str,
        new_filter: Callable[[ClientConnection], ConnectionFilter],
    ) -> None:
        self.name = name
        """The name in the General parameters."""
        self.limits = LIMITS
        self.new_filter = new_filter
        self.connections: set[ClientConnection] = set()
        self.sent: Counter[tuple[ComponentType, ...]] = Counter()
        """How many frames were sent to all clients together, by the components in them."""
        self._measurement = measurement
        self._num_accepted = 0  # connections since the server's start
        self._dropped_for_closed = 0  # frames dropped on connections that have ended

    def elapsed_us(self) -> int | None:
        """Return the measurement's time in µs, negative before it begins; None while none runs."""
        return self._measurement.elapsed_us()

    def frames(self, components: Sequence[ComponentType]) -> FrameSource:
        """Return the frames with these components; an empty sequence means all."""
        return self._measurement.frames(components)

    def parameters_xml(self, sections: Sequence[str], general: General) -> bytes:
        """Return the XML of some sections; see Scene."""
        return self._measurement.scene.parameters_xml(sections, general)

    @abstractmethod
    def frames_requested(self) -> int | None:
        """Start the measurement if it waits for the first request for frames; return ``elapsed_us``."""

    @abstractmethod
    def schedule(self) -> None:
        """Set the timer again in the loop's next turn, once for all connections that ask for it."""

    def connection_opened(self, connection: ClientConnection) -> int:
        """Add a new connection; return its number."""
        self._num_accepted += 1
        self.connections.add(connection)
        self.log_opened(connection)
        return self._num_accepted

    def connection_closed(self, connection: ClientConnection, error: Exception | None) -> None:
        """Remove a connection that has ended, because of ``error`` or regularly."""
        self.connections.discard(connection)
        self._dropped_for_closed += connection.session.frames_dropped
        self.log_closed(connection, error)
        self.schedule()

    def log_opened(self, connection: ClientConnection) -> None:
        """Log a new connection, which may be closed here."""
        _log.info("%s: connected, number %d", connection.name, self._num_accepted)

    def log_closed(self, connection: ClientConnection, error: Exception | None) -> None:
        """Log that a connection has ended."""
        _log.info("%s: disconnected%s", connection.name, f" ({error})" if error else "")

    def reading_stopped(self, connection: ClientConnection, *, is_first: bool) -> None:
        """Note that a client does not read, for the first time or again."""
        _log.log(
            logging.WARNING if is_first else logging.DEBUG,
            "%s does not read: %d MiB wait for it; dropping its frames until it reads again",
            connection.name,
            self.limits.unread_bytes_each >> 20,
        )

    def reading_resumed(self, connection: ClientConnection) -> None:
        """Note that a client reads again."""
        num_dropped = connection.session.frames_dropped
        _log.info("%s reads again; %d of its frames were dropped", connection.name, num_dropped)
