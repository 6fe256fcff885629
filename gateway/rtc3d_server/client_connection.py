"""One client's TCP connection to the simulator, and the count of what was sent on it."""

import asyncio
import logging
import time
from collections import Counter, deque
from dataclasses import replace
from typing import TYPE_CHECKING, Final, cast

import gateway
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import Packet, PacketReader
from gateway.rtc3d.parameters import General, Parameters
from gateway.rtc3d_server.client_session import ClientSession, Server, error_packet
from gateway.simulator.faults.line import Line

if TYPE_CHECKING:
    from gateway.rtc3d_server.server import Simulator

NAME: Final = "RTC3D simulator"
MAX_COMMAND_BYTES: Final = 64 * 1024
MAX_UNREAD_BYTES: Final = 4 * 1024 * 1024
"""What is kept for a client that does not read; beyond it, frames for that client are dropped."""

_log = logging.getLogger(__name__)


class SentCounts:
    """Counts data frames and the components in them."""

    def __init__(self) -> None:
        self._frames: Counter[tuple[ComponentType, ...]] = Counter()

    def add(self, components: tuple[ComponentType, ...]) -> None:
        """Count one frame of these components."""
        self._frames[components] += 1

    @property
    def frames(self) -> int:
        """How many frames were counted."""
        return self._frames.total()

    @property
    def components(self) -> Counter[str]:
        """How many of each component were in them, by the components' keys."""
        counts: Counter[str] = Counter()
        for components, frames in self._frames.items():
            counts.update({component.key: frames for component in components})
        return counts


class ClientConnection(asyncio.Protocol):
    """One client's TCP connection: packets in to its Client, replies and due frames out.

    Nagle's algorithm is off (§2.1): the loop does that for every TCP connection. Each packet is
    written at once and alone, since common clients read one with one recv (field note 15). A client
    that does not read is not read from either, and its frames are dropped.
    """

    transport: asyncio.Transport
    number: int
    """Which connection it is, from 1 since the server's start."""

    def __init__(self, simulator: "Simulator") -> None:
        self._simulator = simulator
        self._loop = asyncio.get_running_loop()
        self._reader = PacketReader(max_packet_bytes=MAX_COMMAND_BYTES, max_c3d_bytes=MAX_COMMAND_BYTES)
        self._inbox: deque[Packet] = deque()
        self._is_full = False  # MAX_UNREAD_BYTES wait for the client to read
        self._was_full = False
        self._first_sent_s: float | None = None  # monotonic times of this session's first and newest frame
        self._last_sent_s = 0.0
        self.closed: asyncio.Future[None] = self._loop.create_future()
        self.counts = SentCounts()
        """What was sent to this client so far."""
        self.line: Line | None = None
        """What changes this connection's bytes, while faults of it are on."""
        self.client = ClientSession(Server(simulator.frames, self._parameters, simulator.measurement_us))

    @property
    def due_us(self) -> int | None:
        """When the next frame is due, in µs since the measurement's start; None if none is to be sent."""
        return self.client.due_us if self._can_send() else None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """See asyncio.Protocol."""
        self.transport = cast(asyncio.Transport, transport)
        self.transport.set_write_buffer_limits(high=MAX_UNREAD_BYTES)
        peer = transport.get_extra_info("peername")
        self.client.name = f"{peer[0]}:{peer[1]}"
        self._simulator.admit(self)
        _log.info("%s: connected, number %d", self.client.name, self.number)
        if not self._simulator.is_listening:
            self.transport.abort()  # accepted in the moment in which the server vanished

    def connection_lost(self, exc: Exception | None) -> None:
        """See asyncio.Protocol."""
        _log.info("%s: disconnected%s", self.client.name, f" ({exc})" if exc else "")
        self._inbox.clear()
        if self.line is not None:
            self.line.close()
        self._simulator.forget(self)
        self.closed.set_result(None)

    def pause_writing(self) -> None:
        """Stop sending and reading: the client does not read (asyncio.Protocol)."""
        self._is_full = True
        self.transport.pause_reading()
        _log.log(
            logging.DEBUG if self._was_full else logging.WARNING,
            "%s does not read: %d MiB wait for it, and its frames are dropped until it does",
            self.client.name,
            MAX_UNREAD_BYTES >> 20,
        )
        self._was_full = True

    def resume_writing(self) -> None:
        """Go on: the client reads again (asyncio.Protocol)."""
        self._is_full = False
        elapsed_us = self._simulator.elapsed_us()
        if elapsed_us is not None:
            self.client.drop_due(elapsed_us)
        _log.info(
            "%s reads again; %d of its frames were dropped", self.client.name, self.client.frames_dropped
        )
        self.resume_reading()
        self._simulator.schedule()
        self._work()

    def resume_reading(self) -> None:
        """Read again, unless the client does not read what it was sent, or is leaving."""
        if self._can_send():
            self.transport.resume_reading()

    def data_received(self, data: bytes) -> None:
        """See asyncio.Protocol."""
        if self.line is None or not self.line.holds(data):
            self.take(data)

    def take(self, data: bytes) -> None:
        """Act on the next bytes that the client sent."""
        is_idle = not self._inbox
        self._inbox.extend(self._reader.feed(data))
        if is_idle:
            self._work()

    def send_due(self, elapsed_us: int) -> None:
        """Send the frames that are due by now, or drop them if the client does not read or is leaving."""
        if not self._can_send():
            self.client.drop_due(elapsed_us)
            return
        for packet, components in self.client.due(elapsed_us):
            self.send(packet)
            self.counts.add(components)
            self._simulator.counts.add(components)
            self._last_sent_s = time.monotonic()
            if self._first_sent_s is None:
                self._first_sent_s = self._last_sent_s
            if not self._can_send():
                break

    def send(self, packet: bytes) -> None:
        """Send one packet, as the faults that are on for this client have it."""
        if self.line is None:
            self.write(packet)
        else:
            self.line.send(packet)

    def write(self, data: bytes) -> None:
        """Send bytes as they are, with one send; everything that leaves for this client goes through here."""
        if not self.transport.is_closing():
            self.transport.write(data)

    def close(self) -> None:
        """Close the connection once everything has been sent; ``closed`` is done then."""
        self._inbox.clear()
        if self.line is not None:
            self.line.flush()
        self.transport.close()

    def _can_send(self) -> bool:
        return not (self._is_full or self.transport.is_closing())

    def _work(self) -> None:
        """Answer one packet, the others in the loop's next rounds, so that no client holds up another."""
        if not self._can_send():
            return
        if self._inbox:
            command = self._inbox.popleft()
            for reply in self.client.answer(command) if self.line is None else self.line.answer(command):
                self.send(reply)
            if self.client.said_bye:
                self.close()
                return
            elapsed_us = self._simulator.elapsed_us()
            if elapsed_us is not None:
                self.send_due(elapsed_us)
            self._simulator.schedule()
        if self._inbox:
            self._loop.call_soon(self._work)
        elif self._reader.error is not None:
            size = self._reader.error.size
            self.send(
                error_packet(f"A packet of {size} bytes is out of bounds (8 to {MAX_COMMAND_BYTES}); closing")
            )
            self.close()

    def _parameters(self) -> Parameters:
        address, port = self.transport.get_extra_info("sockname")[:2]
        frames = self.counts.frames
        streaming_s = 0.0 if self._first_sent_s is None else self._last_sent_s - self._first_sent_s
        general = General(
            name=NAME,
            version=gateway.__version__,
            address=address,
            port=port,
            frames_sent=frames,
            frames_per_s=round((frames - 1) / streaming_s, 2) if streaming_s > 0 else 0.0,
        )
        return replace(self._simulator.scene.parameters, general=general)
