"""The simulator's server: listens, keeps the measurement's time, sends each client what is due."""

import asyncio
import logging
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import replace
from types import TracebackType
from typing import Final, Self, cast

import gateway
from gateway.errors import GatewayError
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import Packet, PacketReader
from gateway.rtc3d.parameters import General, Parameters
from gateway.simulator.client import Client, Server, error_packet
from gateway.simulator.frames import FrameBuilder, exact_rate, time_us
from gateway.simulator.scene import Scene

NAME: Final = "RTC3D simulator"
MAX_COMMAND_BYTES: Final = 64 * 1024
MAX_UNREAD_BYTES: Final = 4 * 1024 * 1024
"""What is kept for a client that does not read; beyond it, frames for that client are dropped."""

_CLOSING_S: Final = 1.0  # for clients to take what was sent before close() cuts them off
_log = logging.getLogger(__name__)


class Simulator:
    """An RT server that plays a scene on a TCP port.

    ``port`` 0 takes a free one; the attribute ``port`` has it after ``start``. ``event_bytes`` is 24
    as NDI's code writes events, or 16 as §7.7 has them (field note 6). The measurement begins with
    ``start``, or, with ``once``, with the first request for frames, and then ends after one pass of
    the scene. Use it as an asynchronous context manager, or call ``start`` and ``close``.
    """

    def __init__(
        self,
        scene: Scene,
        host: str = "127.0.0.1",
        port: int = 0,
        *,
        event_bytes: int = 24,
        once: bool = False,
    ) -> None:
        self.scene = scene
        self.host = host
        self.port = port
        self.connections: set[Connection] = set()
        self.counts = SentCounts()
        """What was sent to all clients so far."""
        self._dropped_before = 0  # by clients no longer connected
        self._event_bytes = event_bytes
        self._once = once
        self._builders: dict[frozenset[ComponentType], FrameBuilder] = {}
        self._started_s: float | None = None  # loop time of the measurement's start
        self._end_us: int | None = None  # of a measurement that is one pass of the scene
        self._has_measured = False
        self._server: asyncio.Server | None = None
        self._timer: asyncio.TimerHandle | None = None

    @property
    def sent(self) -> Counter[str]:
        """How many of each component were sent to all clients so far, by the components' keys."""
        return self.counts.components

    @property
    def frames_sent(self) -> int:
        """How many frames were sent to all clients so far."""
        return self.counts.frames

    @property
    def frames_dropped(self) -> int:
        """How many frames clients missed so far because they did not read or the server was late."""
        return self._dropped_before + sum(c.client.frames_dropped for c in self.connections)

    async def start(self) -> None:
        """Listen, and begin the measurement unless it waits for the first request.

        Raises GatewayError if the address cannot be listened on.
        """
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(lambda: Connection(self), self.host, self.port)
        except OSError as error:
            raise GatewayError(
                f"The simulator cannot listen on {self.host}, port {self.port}: {error.strerror or error}; "
                "give it an address of this machine and a port that is free"
            ) from error
        self.port = self._server.sockets[0].getsockname()[1]
        if not self._once:
            self.start_measurement()

    async def close(self) -> None:
        """End the measurement, close the connections, and stop listening."""
        self.stop_measurement()
        if self._server is None:
            return
        self._server.close()
        connections = list(self.connections)
        for connection in connections:
            connection.close()
        if connections:
            await asyncio.wait([connection.closed for connection in connections], timeout=_CLOSING_S)
        for connection in connections:
            connection.transport.abort()
        await self._server.wait_closed()
        self._server = None

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.close()

    def start_measurement(self) -> None:
        """Begin a measurement, unless one runs: frame numbers and time stamps start anew, streams go on."""
        if self._started_s is not None:
            return
        self._started_s = asyncio.get_running_loop().time()
        self._has_measured = True
        if self._once and self.scene.num_frames is not None:
            self._end_us = time_us(self.scene.num_frames, exact_rate(self.scene.measurement_rate_hz))
        self._builders.clear()
        _log.info("Measurement started")
        for connection in self.connections:
            connection.client.measurement_started()
        self.schedule()

    def stop_measurement(self) -> None:
        """End the measurement, if one runs: clients that wait for frames get a No Data packet."""
        if self._started_s is None:
            return
        self._started_s = None
        _log.info("Measurement stopped")
        for connection in list(self.connections):
            for packet in connection.client.measurement_stopped():
                connection.send(packet)
        self.schedule()

    def elapsed_us(self) -> int | None:
        """Return the time since the measurement's start in µs, None if none runs."""
        if self._started_s is None:
            return None
        elapsed_us = int((asyncio.get_running_loop().time() - self._started_s) * 1e6)
        # what would be due at the end itself is the first frame of another pass
        return elapsed_us if self._end_us is None else min(elapsed_us, self._end_us - 1)

    def measurement_us(self) -> int | None:
        """Return ``elapsed_us`` to a client that wants frames; a pass that waits for that begins now."""
        if self._once and not self._has_measured:
            self.start_measurement()
            return 0
        return self.elapsed_us()

    def frames(self, components: Sequence[ComponentType]) -> FrameBuilder:
        """Return the builder, shared by all clients, of a choice of components."""
        choice = frozenset(components)
        if choice not in self._builders:
            self._builders[choice] = FrameBuilder(self.scene, components, self._event_bytes)
        return self._builders[choice]

    def forget(self, connection: "Connection") -> None:
        """Take a connection that has ended off the list."""
        self.connections.discard(connection)
        self._dropped_before += connection.client.frames_dropped
        self.schedule()

    def schedule(self) -> None:
        """Set the timer to when the next frame is due to any client, or the pass ends."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._started_s is None:
            return
        due = [self._end_us, *(connection.due_us for connection in self.connections)]
        next_us = min((due_us for due_us in due if due_us is not None), default=None)
        if next_us is not None:
            # a microsecond later, lest the rounding of float seconds wakes us just before it
            when_s = self._started_s + (next_us + 1) / 1e6
            self._timer = asyncio.get_running_loop().call_at(when_s, self._send_due)

    def _send_due(self) -> None:
        elapsed_us = self.elapsed_us()
        if elapsed_us is None:
            return
        for connection in list(self.connections):
            connection.send_due(elapsed_us)
        if self._end_us is not None and elapsed_us >= self._end_us - 1:
            self.stop_measurement()
        else:
            self.schedule()


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


class Connection(asyncio.Protocol):
    """One client's TCP connection: packets in to its Client, replies and due frames out.

    Nagle's algorithm is off (§2.1): asyncio does that for every TCP connection. Each packet is
    written at once and alone, since common clients read one with one recv (field note 15). A client
    that does not read is not read from either, and its frames are dropped.
    """

    transport: asyncio.Transport

    def __init__(self, simulator: Simulator) -> None:
        self._simulator = simulator
        self._loop = asyncio.get_running_loop()
        self._reader = PacketReader(max_packet_bytes=MAX_COMMAND_BYTES, max_c3d_bytes=MAX_COMMAND_BYTES)
        self._inbox: deque[Packet] = deque()
        self._is_full = False  # MAX_UNREAD_BYTES wait for the client to read
        self._was_full = False
        self._first_sent_s: float | None = None  # loop times of this session's first and newest frame
        self._last_sent_s = 0.0
        self.closed: asyncio.Future[None] = self._loop.create_future()
        self.counts = SentCounts()
        """What was sent to this client so far."""
        self.client = Client(Server(simulator.frames, self._parameters, simulator.measurement_us))

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
        self._simulator.connections.add(self)
        _log.info("%s: connected", self.client.name)

    def connection_lost(self, exc: Exception | None) -> None:
        """See asyncio.Protocol."""
        _log.info("%s: disconnected%s", self.client.name, f" ({exc})" if exc else "")
        self._inbox.clear()
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
        if not self.transport.is_closing():
            self.transport.resume_reading()
        self._simulator.schedule()
        self._work()

    def data_received(self, data: bytes) -> None:
        """See asyncio.Protocol."""
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
            self._last_sent_s = self._loop.time()
            if self._first_sent_s is None:
                self._first_sent_s = self._last_sent_s
            if not self._can_send():
                break

    def send(self, packet: bytes) -> None:
        """Send one packet; everything that leaves for this client goes through here."""
        if not self.transport.is_closing():
            self.transport.write(packet)

    def close(self) -> None:
        """Close the connection once everything has been sent; ``closed`` is done then."""
        self._inbox.clear()
        self.transport.close()

    def _can_send(self) -> bool:
        return not (self._is_full or self.transport.is_closing())

    def _work(self) -> None:
        """Answer one packet, the others in the loop's next rounds, so that no client holds up another."""
        if not self._can_send():
            return
        if self._inbox:
            for packet in self.client.answer(self._inbox.popleft()):
                self.send(packet)
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
