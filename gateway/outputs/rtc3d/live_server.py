"""The RT server of one live source. It runs in the event loop of the output's thread."""

import asyncio
import contextlib
import logging
import math
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, cast

from gateway.logs.failures import EventLog
from gateway.logs.losses import Losses
from gateway.outputs.contract import ServerParameters
from gateway.outputs.rtc3d.client_filter import MAX_HELD_PACKETS, ClientFilter, ControlRecording
from gateway.outputs.rtc3d.live_frames import KEPT_EVENTS
from gateway.outputs.rtc3d.live_scene import LiveScene
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import Frame
from gateway.rtc3d_server.client_connection import LIMITS, ClientConnection
from gateway.rtc3d_server.client_session import error_packet
from gateway.rtc3d_server.connection_filter import ConnectionFilter, FilteredConnection
from gateway.rtc3d_server.scene import FrameSource
from gateway.rtc3d_server.server import RtServer
from gateway.server_limits import Clients
from gateway.workers import WorkerThread

SLOW_CLIENT: Final = "slow client"
"""The cause of frames that a client did not get because it does not read fast enough."""

FILE: Final = "C3D file"
"""The cause of C3D files that a client did not get."""

_NO_FRAMES_S: Final = 2.0
"""How long a client waits for frames before it gets No Data, if it is unknown whether a measurement runs."""

_PARAMETERS_S: Final = 1.0
"""How long a client waits for the parameters while the gateway is connecting to the server."""

_END_S: Final = 0.1
"""How long no frame must have come before a measurement ends."""

_log = logging.getLogger(__name__)


class SourceState:
    """What the gateway knows about a source, and whether its clients ask for frames.

    The gateway's event loop assigns all attributes but ``wanted``; the thread of the clients reads them.
    """

    def __init__(self, source: str) -> None:
        self.source = source
        self.is_streaming = False
        """Whether frames arrive."""
        self.is_measuring: bool | None = None
        """Whether a measurement runs; None if that is unknown."""
        self.parameters = ServerParameters(b"", 0, 0)
        self.losses: Losses | None = None
        self.wanted = False
        """Whether any client asks for frames. The server assigns it."""

    @property
    def has_no_measurement(self) -> bool:
        """Whether it is known that no frames can come now."""
        return not self.is_streaming and self.is_measuring is False


class LiveServer(RtServer):
    """Serves a live source to RTC3D clients.

    A measurement runs from the first frame that arrives until the source has no more. A request for frames
    while nothing is known waits _NO_FRAMES_S for them, because the gateway may have to ask the server first.
    ``wanted_changed`` is called after ``state.wanted`` has changed, ``control`` to start or stop a recording.
    """

    def __init__(
        self,
        state: SourceState,
        host: str,
        port: int,
        max_clients: int,
        wanted_changed: Callable[[], None],
        control: ControlRecording,
    ) -> None:
        self._live_scene = LiveScene(state.source)
        super().__init__(self._live_scene, host, port, name=f"rtc3d.ports.{state.source}")
        self.clients: Clients[ClientFilter] = Clients(LIMITS, ClientFilter.abort)
        self.set_max_clients(max_clients)
        self._state = state
        self._applied_parameters: ServerParameters | None = None
        self._wanted_changed = wanted_changed
        self._control = control
        self._events = EventLog(_log, f"{state.source} to rtc3d")
        self._giving_up: asyncio.TimerHandle | None = None  # waits for frames, before No Data
        self._ending: asyncio.TimerHandle | None = None  # waits for the last frames, before No Data
        self._last_frame_s = -math.inf
        self._heard = asyncio.Event()  # set once anything is known of the source
        # How many dropped frames and frames without events of each client are in the losses.
        self._num_counted: dict[ClientConnection, tuple[int, int]] = {}
        self.disk = WorkerThread(f"{state.source} files")
        """Reads C3D files."""

    # From the gateway -----------------------------------------------------------------------

    def set_max_clients(self, max_clients: int) -> None:
        """Serve so many clients at most from now on; those that are connected may stay."""
        self.limits = self.clients.limits = replace(LIMITS, clients=max_clients)

    def take(self, frame: Frame, stream: int, wanted: frozenset[ComponentType]) -> None:
        """Send a frame that has just arrived on this stream to the clients that want it."""
        if not self._state.wanted:
            return
        self.apply_parameters()
        self._stop_waiting()
        self._last_frame_s = asyncio.get_running_loop().time()
        elapsed_us = self.elapsed_us()
        if elapsed_us is None:
            self.start_measurement()
            elapsed_us = self.elapsed_us() or 0
        if self._live_scene.add(frame, stream, wanted, elapsed_us):
            self.send_due_frames()
            self.check_wanted()

    def apply_state(self) -> None:
        """Serve the newest parameters, and end the measurement if the source has no frames any more.

        Frames of a backlog may still come, so it ends when none has come for a moment.
        """
        self.apply_parameters()
        state = self._state
        if self.is_known:
            self._heard.set()
        is_waiting = self._giving_up is not None and not state.has_no_measurement
        if self.elapsed_us() is None or state.is_streaming or is_waiting:
            return
        loop = asyncio.get_running_loop()
        if loop.time() - self._last_frame_s >= _END_S:
            self._stop_waiting()
            self.stop_measurement()
        elif self._ending is None:
            self._ending = loop.call_later(_END_S, self._end)

    def _end(self) -> None:
        self._ending = None
        self.apply_state()

    def apply_parameters(self) -> None:
        """Serve the newest parameters of the source."""
        parameters = self._state.parameters
        if parameters is not self._applied_parameters:
            self._applied_parameters = parameters
            self._live_scene.set_parameters(parameters.xml, parameters.parsed)

    @property
    def is_known(self) -> bool:
        """Whether anything is known of the source: parameters, frames, or that it has none."""
        state = self._state
        return state.parameters.version > 0 or state.is_streaming or state.is_measuring is not None

    async def wait_until_known(self) -> None:
        """Wait until ``is_known``, but not for long."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_PARAMETERS_S):
                await self._heard.wait()

    def send_file(self, path: Path) -> None:
        """Send a C3D file to every client that has sent a command."""
        for client in self.clients.served:
            client.send_file(path)

    def maintain(self) -> None:
        """Count the frames that slow clients have lost. Call it once a second."""
        for connection in self.connections:
            self._count_dropped(connection)
        self.check_wanted()  # after a change of the port, the former server has said that nothing is wanted

    # RtServer -------------------------------------------------------------------------------

    def elapsed_us(self) -> int | None:
        """See RtServer. The newest frame is never in the future."""
        elapsed_us = super().elapsed_us()
        return None if elapsed_us is None else max(elapsed_us, self._live_scene.newest_us)

    def frames(self, components: Sequence[ComponentType]) -> FrameSource:
        """See RtServer. Frames that no client asks for are not made."""
        return self._live_scene.frames(components)

    def next_frame_us(self) -> int | None:
        """See RtServer. Frames are sent when they arrive."""
        return None

    def send_frames(self, elapsed_us: int) -> None:
        """See RtServer. Most frames of a fast stream are none for clients that want a slower one, too."""
        if self._live_scene.has_new_frames:
            self._live_scene.has_new_frames = False
            super().send_frames(elapsed_us)

    def frames_requested(self) -> int | None:
        """See RtServer."""
        if self.elapsed_us() is None and not self._state.has_no_measurement:
            self.start_measurement()
            if not self._state.is_streaming:
                self._giving_up = asyncio.get_running_loop().call_later(_NO_FRAMES_S, self._give_up)
        return self.elapsed_us()

    def new_filter(self, connection: FilteredConnection) -> ConnectionFilter:
        """See RtServer."""
        return ClientFilter(connection, self)

    async def close(self) -> None:
        """See RtServer."""
        self._stop_waiting()
        if self._ending is not None:
            self._ending.cancel()
        await super().close()
        self.check_wanted()

    # For connections ------------------------------------------------------------------------

    def control_recording(self, *, start: bool, options: str) -> Coroutine[Any, Any, str]:
        """Start or stop a recording on the source's server; return its reply or "". Raises QueryError."""
        return self._control(self._state.source, start, options)

    def file_lost(self, client: str, path: Path, reason: str) -> None:
        """Count and log a C3D file that a client does not get."""
        if self._state.losses is not None:
            text = f"client {client} does not get {path.name}: {reason}; the gateway keeps files in its spool"
            self._state.losses.lost(FILE, text, frames=0)

    def packet_lost(self, client: str) -> None:
        """Count and log a packet that a client does not get, because it reads a C3D file too slowly."""
        if self._state.losses is not None:
            text = (
                f"client {client} reads a C3D file too slowly: {MAX_HELD_PACKETS} packets wait for its end, "
                "further ones are dropped; check that program, or the network to it"
            )
            self._state.losses.lost(SLOW_CLIENT, text, frames=0)

    def check_wanted(self) -> None:
        """Note whether any client asks for frames now."""
        wanted = any(connection.session.wants_frames for connection in self.connections)
        if wanted is not self._state.wanted:
            self._state.wanted = wanted
            if not wanted:
                self._live_scene.forget_frames()
            self._wanted_changed()

    def log_opened(self, connection: ClientConnection) -> None:
        """Log a new client, and turn away one that is too many."""
        if not self.clients.is_full:
            self.clients.open(cast(ClientFilter, connection.filter))
            text = f"client {connection.name} connected ({len(self.clients)} now)"
            self._events.log(logging.INFO, text, "connected")
            return
        most = self.limits.clients
        self._events.log(
            logging.WARNING,
            f"client {connection.name} was turned away: {most} clients are connected; close some, or raise "
            "rtc3d.max_clients",
            "too many",
        )
        connection.write(error_packet(f"This gateway serves {most} clients at most; closing"))
        connection.close()

    def log_closed(self, connection: ClientConnection, error: Exception | None) -> None:
        """Log that a client has gone, and count what it lost."""
        self._count_dropped(connection)
        self._num_counted.pop(connection, None)
        self.check_wanted()
        reason = f" ({error})" if error else ""
        self._events.log(logging.INFO, f"client {connection.name} disconnected{reason}", "disconnected")

    def reading_stopped(self, connection: ClientConnection, *, is_first: bool) -> None:
        """See RtServer."""
        mib = self.limits.unread_bytes_each / 2**20
        text = (
            f"client {connection.name} does not read: {mib:.2g} MiB wait for it; "
            "its frames are dropped until it reads again; check that program, or the network to it"
        )
        self._events.log(logging.WARNING if is_first else logging.DEBUG, text, "slow")

    def reading_resumed(self, connection: ClientConnection) -> None:
        """See RtServer."""
        self._count_dropped(connection)
        num_dropped = connection.session.frames_dropped
        text = f"client {connection.name} reads again; {num_dropped} of its frames were dropped"
        self._events.log(logging.INFO, text, "reads again")

    def log_measurement(self, text: str) -> None:
        """Log nothing loudly: the status of the source says whether a measurement runs."""
        _log.debug("%s: %s", self._state.source, text)

    def _count_dropped(self, connection: ClientConnection) -> None:
        losses = self._state.losses
        if losses is None:
            return
        session = connection.session
        frames, lacking = self._num_counted.get(connection, (0, 0))
        self._num_counted[connection] = (session.frames_dropped, session.frames_without_events)
        if num_new := session.frames_dropped - frames:
            losses.lost(
                SLOW_CLIENT,
                f"client {connection.name} does not read fast enough; only its own frames are dropped; check "
                "that program, or let it ask for fewer frames",
                messages=num_new,
                frames=num_new,
                level=logging.DEBUG,  # reading_stopped has logged it
            )
        if num_new := session.frames_without_events - lacking:
            losses.lost(
                SLOW_CLIENT,
                f"client {connection.name} has not taken frames for so long that events are dropped: "
                f"{KEPT_EVENTS} frames with events wait for it; check that program, or let it ask for more "
                "frames",
                messages=num_new,
                frames=num_new,
            )

    def _give_up(self) -> None:
        self._giving_up = None
        self.apply_state()

    def _stop_waiting(self) -> None:
        if self._giving_up is not None:
            self._giving_up.cancel()
            self._giving_up = None
