"""The simulator's server: listens, and keeps the measurement's time for all clients."""

import asyncio
import logging
import math
import time
from collections import Counter
from collections.abc import Sequence
from types import TracebackType
from typing import Final, Self

from gateway.errors import GatewayError
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d_server.client_connection import ClientConnection, SentCounts
from gateway.rtc3d_server.frame_builder import FrameBuilder, exact_rate, time_us
from gateway.rtc3d_server.scene import Scene
from gateway.simulator.faults.control import Faults

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
        self.connections: set[ClientConnection] = set()
        self.counts = SentCounts()
        """What was sent to all clients so far."""
        self.faults = Faults(self)
        """What goes wrong on purpose; nothing unless it is told to."""
        self._accepted = 0  # connections since the server's start
        self._dropped_before = 0  # by clients no longer connected
        self._event_bytes = event_bytes
        self._once = once
        self._builders: dict[frozenset[ComponentType], FrameBuilder] = {}
        self._started_us: int | None = None  # monotonic time of the measurement's start
        self._end_us: int | None = None  # of a measurement that is one pass of the scene
        self._has_measured = False
        self._server: asyncio.Server | None = None
        self._timer: asyncio.TimerHandle | None = None

    @property
    def is_listening(self) -> bool:
        """Whether clients can connect."""
        return self._server is not None and self._server.is_serving()

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
            self._server = await loop.create_server(lambda: ClientConnection(self), self.host, self.port)
        except OSError as error:
            raise GatewayError(
                f"The simulator cannot listen on {self.host}, port {self.port}: {error.strerror or error}; "
                "give it an address of this machine and a port that is free"
            ) from error
        self.port = self._server.sockets[0].getsockname()[1]
        self._accepted = 0
        self._has_measured = False
        if not self._once:
            self.start_measurement()

    async def close(self) -> None:
        """End the faults and the measurement, close the connections, and stop listening."""
        await self.faults.close()
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

    def vanish(self) -> None:
        """End as if the process died: nobody is told. ``start`` brings the server back, on the same port."""
        for connection in list(self.connections):
            connection.transport.abort()
        self.stop_measurement()
        server, self._server = self._server, None
        if server is not None:
            server.close()

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
        if self._started_us is not None:
            return
        self._started_us = _now_us()
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
        if self._started_us is None:
            return
        self._started_us = None
        _log.info("Measurement stopped")
        for connection in list(self.connections):
            for packet in connection.client.measurement_stopped():
                connection.send(packet)
        self.schedule()

    def change_scene(self, scene: Scene) -> None:
        """Play another scene from now on; a measurement that runs goes on with it, its time stamps too."""
        self.scene = scene
        self._builders.clear()
        for connection in self.connections:
            connection.client.scene_changed()
        self.schedule()

    def elapsed_us(self) -> int | None:
        """Return the time since the measurement's start in µs, None if none runs."""
        if self._started_us is None:
            return None
        elapsed_us = _now_us() - self._started_us
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

    def admit(self, connection: ClientConnection) -> None:
        """Put a new connection on the list, and give it its number."""
        self._accepted += 1
        connection.number = self._accepted
        self.connections.add(connection)
        self.faults.connected(connection)

    def forget(self, connection: ClientConnection) -> None:
        """Take a connection that has ended off the list."""
        self.connections.discard(connection)
        self._dropped_before += connection.client.frames_dropped
        self.schedule()

    def schedule(self) -> None:
        """Set the timer to when the next frame is due to any client, or the pass ends."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._started_us is None:
            return
        due = [self._end_us, *(connection.due_us for connection in self.connections)]
        next_us = min((due_us for due_us in due if due_us is not None), default=None)
        if next_us is not None:
            # uvloop rounds to whole milliseconds: up here, lest it wakes us again and again just before it.
            wait_ms = math.ceil((self._started_us + next_us - _now_us()) / 1000)
            self._timer = asyncio.get_running_loop().call_later(max(0, wait_ms) / 1000, self._send_due)

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


def _now_us() -> int:
    return time.monotonic_ns() // 1000
