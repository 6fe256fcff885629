"""The RT server: accepts clients, and sends each of them the frames that it requested."""

import asyncio
import logging
from collections import Counter
from collections.abc import Callable
from types import TracebackType
from typing import Self

from typing_extensions import override

from gateway.errors import PortError, system_reason
from gateway.session.server.client_connection import ClientConnection, ConnectionFilter, ConnectionOwner
from gateway.session.server.measurement import Measurement, call_after_us
from gateway.session.server.scene import Scene

_log = logging.getLogger(__name__)


class RtServer(ConnectionOwner):
    """Serves a scene on a TCP port.

    With ``port`` 0 the system chooses a free port, which ``port`` contains after ``start``.
    ``event_bytes`` is the size of an event: 24 as NDI's code writes events, or 16 as in §7.7 (field
    note 6). The measurement starts with ``start``; with ``once``, it starts a second after the first
    request for frames (LEAD_US) and ends after one pass of the scene. ``name`` is the server's name in
    the General parameters. ``new_filter`` returns the filter of a new connection; the default changes
    nothing.

    Use it as an asynchronous context manager, or call ``start`` and ``close``.
    """

    def __init__(
        self,
        scene: Scene,
        host: str = "127.0.0.1",
        port: int = 0,
        *,
        event_bytes: int = 24,
        once: bool = False,
        name: str = "RTC3D server",
        new_filter: Callable[[ClientConnection], ConnectionFilter] = ConnectionFilter,
    ) -> None:
        super().__init__(Measurement(scene, event_bytes=event_bytes, once=once), name, new_filter)
        self.host = host
        self.port = port
        self._once = once
        self._starts_on_request = once  # whether the next request for frames starts the measurement
        self._server: asyncio.Server | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._is_scheduling = False  # whether _set_timer is to be called

    @property
    def scene(self) -> Scene:
        """The scene that is served."""
        return self._measurement.scene

    @property
    def is_listening(self) -> bool:
        """Whether clients can connect."""
        return self._server is not None and self._server.is_serving()

    @property
    def components_sent(self) -> Counter[str]:
        """How often each component was sent, to all clients together, by its key."""
        counts: Counter[str] = Counter()
        for components, frames in self.sent.items():
            counts.update({component.key: frames for component in components})
        return counts

    @property
    def frames_sent(self) -> int:
        """The number of frames sent to all clients together."""
        return self.sent.total()

    @property
    def frames_dropped(self) -> int:
        """The number of frames dropped because clients did not read or the server was late."""
        return self._dropped_for_closed + sum(each.session.frames_dropped for each in self.connections)

    # Life cycle -----------------------------------------------------------------------------

    async def start(self) -> None:
        """Listen, and start the measurement unless it waits for the first request for frames.

        Raises PortError if the server cannot listen on the address.
        """
        await self.listen()
        self._starts_on_request = self._once
        if not self._once:
            self.start_measurement()

    async def listen(self) -> None:
        """Listen for clients. Raises PortError if that is not possible on the address."""
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(lambda: ClientConnection(self), self.host, self.port)
        except OSError as error:
            raise PortError(
                f"{self.name}: cannot listen on {self.host}, port {self.port}: {system_reason(error)}; "
                "choose an address of this machine and a free port"
            ) from error
        self.port = self._server.sockets[0].getsockname()[1]
        self._num_accepted = 0

    async def close(self) -> None:
        """Stop the measurement, close the connections, and stop listening."""
        self.stop_measurement()
        if self._server is None:
            return
        self._server.close()
        connections = list(self.connections)
        for connection in connections:
            connection.close()
        if connections:
            await asyncio.wait([connection.closed for connection in connections], timeout=self.limits.close_s)
        for connection in connections:
            connection.transport.abort()
        await self._server.wait_closed()
        self._server = None

    def crash(self) -> None:
        """End as if the process died: abort all connections without a packet, and stop listening.

        ``start`` lets the server return on the same port.
        """
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

    @override
    def connection_opened(self, connection: ClientConnection) -> int:
        number = super().connection_opened(connection)
        if not self.is_listening:
            connection.transport.abort()  # accepted at the moment of a crash
        return number

    # The measurement ------------------------------------------------------------------------

    def start_measurement(self) -> None:
        """Start a measurement, unless one is running.

        Frame numbers and time stamps start over; clients' streams continue with the first frame.
        """
        if self._measurement.is_running:
            return
        self._measurement.start()
        self._starts_on_request = False
        self.log_measurement("Measurement started")
        for connection in self.connections:
            connection.session.measurement_started()
        self.schedule()

    def stop_measurement(self) -> None:
        """Stop the measurement, if one is running; clients that wait for frames get a No Data packet."""
        if not self._measurement.is_running:
            return
        self._measurement.stop()
        self.log_measurement("Measurement stopped")
        for connection in list(self.connections):
            connection.measurement_stopped()
        self.schedule()

    def log_measurement(self, text: str) -> None:
        """Log that a measurement has started or stopped."""
        _log.info(text)

    def change_scene(self, scene: Scene) -> None:
        """Serve another scene from now on; a running measurement and its time stamps continue."""
        self._measurement.change_scene(scene)
        for connection in self.connections:
            connection.session.scene_changed(self.elapsed_us() or 0)
        self.schedule()

    @override
    def frames_requested(self) -> int | None:
        if self._starts_on_request:
            self.start_measurement()
        else:
            self._measurement.postpone()
        return self.elapsed_us()

    # Sending --------------------------------------------------------------------------------

    def next_frame_us(self) -> int | None:
        """Return when the next frame is due for any client; None if that is unknown."""
        due_us = (connection.due_us for connection in self.connections)
        return min((time_us for time_us in due_us if time_us is not None), default=None)

    @override
    def schedule(self) -> None:
        if not self._is_scheduling:
            self._is_scheduling = True
            asyncio.get_running_loop().call_soon(self._set_timer)

    def _set_timer(self) -> None:
        """Set the timer to when the next frame is due for any client, or when the measurement ends."""
        self._is_scheduling = False
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        elapsed_us = self.elapsed_us()
        if elapsed_us is None:
            return
        due_us = (self._measurement.last_us, self._measurement.advance_us, self.next_frame_us())
        next_us = min((time_us for time_us in due_us if time_us is not None), default=None)
        if next_us is not None:
            self._timer = call_after_us(next_us - elapsed_us, self.send_due_frames)

    def send_due_frames(self) -> None:
        """Send every client the frames that are due, and set the timer for the next ones."""
        self._measurement.advance()
        elapsed_us = self.elapsed_us()
        if elapsed_us is None:
            return
        self.send_frames(elapsed_us)
        if elapsed_us == self._measurement.last_us:
            self.stop_measurement()
        else:
            self._set_timer()

    def send_frames(self, elapsed_us: int) -> None:
        """Send every client the frames that are due at this time."""
        for connection in list(self.connections):
            connection.send_due_frames(elapsed_us)
