"""The RT server of one live source, and its scene. They run in the event loop of the output's thread."""

import asyncio
import logging
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Final, cast
from weakref import WeakValueDictionary

from typing_extensions import override

from gateway.errors import CommandError
from gateway.outputs.adapters.rtc3d.arrivals import NewestFrames
from gateway.outputs.adapters.rtc3d.client_filter import (
    SLOW_CLIENT,
    ClientFilter,
    ControlRecording,
    SourceState,
)
from gateway.outputs.adapters.rtc3d.live_frames import KEPT_EVENTS, LiveFrames
from gateway.outputs.contract import ServerParameters
from gateway.rtc3d.components import WIRE_ORDER, ComponentType, described_rate_hz, num_described_items
from gateway.rtc3d.frames import RawFrame
from gateway.rtc3d.parameters import General, Parameters
from gateway.rtc3d.parameters_xml import cut_sections
from gateway.runtime.failures import EventLog
from gateway.runtime.server_limits import Clients
from gateway.runtime.workers import WorkerThread
from gateway.session.server.client_connection import LIMITS, ClientConnection
from gateway.session.server.client_session import error_packet
from gateway.session.server.scene import FrameSource
from gateway.session.server.server import RtServer

_NO_FRAMES_S: Final = 2.0
"""How long a client waits for frames before it gets No Data, if it is unknown whether a measurement runs."""

_END_S: Final = 0.1
"""How long no frame must have come before a measurement ends."""

_KEPT_CHOICES: Final = 2
_CACHED_SECTIONS: Final = 16  # clients can ask for 63 different choices

_log = logging.getLogger(__name__)


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
        super().__init__(
            self._live_scene,
            host,
            port,
            name=f"rtc3d.ports.{state.source}",
            new_filter=lambda each: ClientFilter(each, state, self.clients, self.disk, control),
        )
        self.clients: Clients[ClientFilter] = Clients(LIMITS, ClientFilter.abort)
        self.set_max_clients(max_clients)
        self._state = state
        self._applied_parameters: ServerParameters | None = None
        self._wanted_changed = wanted_changed
        self._events = EventLog(_log, f"{state.source} to rtc3d")
        self._giving_up: asyncio.TimerHandle | None = None  # waits for frames, before No Data
        self._ending: asyncio.TimerHandle | None = None  # waits for the last frames, before No Data
        self._last_frame_s = -math.inf
        # How many dropped frames and frames without events of each client are in the losses.
        self._num_counted: dict[ClientConnection, tuple[int, int]] = {}
        self.disk = WorkerThread(f"{state.source} files")
        """Reads C3D files."""

    # From the gateway -----------------------------------------------------------------------

    def set_max_clients(self, max_clients: int) -> None:
        """Serve so many clients at most from now on; those that are connected may stay."""
        self.limits = self.clients.limits = replace(LIMITS, clients=max_clients)

    def take(self, frame: RawFrame, stream: int, wanted: frozenset[ComponentType]) -> None:
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
        if state.is_known:
            state.heard.set()
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

    def send_file(self, path: Path) -> None:
        """Send a C3D file to every client that has sent a command."""
        for client in self.clients.served:
            client.send_file(path)

    def maintain(self) -> None:
        """Apply what is new of the source, and count the frames that slow clients have lost.

        Call it once a second, and after a change of the source.
        """
        self.apply_state()
        for connection in self.connections:
            self._count_dropped(connection)
        self.check_wanted()  # after a change of the port, the former server has said that nothing is wanted

    # RtServer -------------------------------------------------------------------------------

    @override
    def elapsed_us(self) -> int | None:
        """The newest frame is never in the future."""
        elapsed_us = super().elapsed_us()
        return None if elapsed_us is None else max(elapsed_us, self._live_scene.newest_us)

    @override
    def frames(self, components: Sequence[ComponentType]) -> FrameSource:
        """Frames that no client asks for are not made."""
        self.apply_parameters()
        return self._live_scene.frames(components)

    @override
    def parameters_xml(self, sections: Sequence[str], general: General) -> bytes:
        self.apply_parameters()
        return super().parameters_xml(sections, general)

    @override
    def next_frame_us(self) -> int | None:
        """Frames are sent when they arrive."""
        return None

    @override
    def send_frames(self, elapsed_us: int) -> None:
        """Most frames of a fast stream are none for clients that want a slower one, too."""
        if self._live_scene.has_new_frames:
            self._live_scene.has_new_frames = False
            super().send_frames(elapsed_us)

    @override
    def frames_requested(self) -> int | None:
        if self.elapsed_us() is None and not self._state.has_no_measurement:
            self.start_measurement()
            if not self._state.is_streaming:
                self._giving_up = asyncio.get_running_loop().call_later(_NO_FRAMES_S, self._give_up)
        return self.elapsed_us()

    @override
    def schedule(self) -> None:
        """What clients ask for may have changed."""
        self.check_wanted()
        super().schedule()

    @override
    async def close(self) -> None:
        self._stop_waiting()
        if self._ending is not None:
            self._ending.cancel()
        await super().close()

    # For connections ------------------------------------------------------------------------

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
        reason = f" ({error})" if error else ""
        self._events.log(logging.INFO, f"client {connection.name} disconnected{reason}", "disconnected")

    @override
    def reading_stopped(self, connection: ClientConnection, *, is_first: bool) -> None:
        mib = self.limits.unread_bytes_each / 2**20
        text = (
            f"client {connection.name} does not read: {mib:.2g} MiB wait for it; "
            "its frames are dropped until it reads again; check that program, or the network to it"
        )
        self._events.log(logging.WARNING if is_first else logging.DEBUG, text, "slow")

    @override
    def reading_resumed(self, connection: ClientConnection) -> None:
        self._count_dropped(connection)
        num_dropped = connection.session.frames_dropped
        text = f"client {connection.name} reads again; {num_dropped} of its frames were dropped"
        self._events.log(logging.INFO, text, "reads again")

    def log_measurement(self, text: str) -> None:
        """Log nothing loudly: the status of the source says whether a measurement runs."""
        _log.debug("%s: %s", self._state.source, text)

    def _count_dropped(self, connection: ClientConnection) -> None:
        losses, session = self._state.losses, connection.session
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


class LiveScene:
    """The scene of a live source (see Scene). Its time is that of the arrival of frames."""

    length_us = None

    def __init__(self, source: str) -> None:
        self._source = source
        self._arrivals = NewestFrames()
        # What clients ask for, by its components. It is there while any client asks for it, and a bit longer,
        # because a client can ask for one frame after the other.
        self._frames: WeakValueDictionary[frozenset[ComponentType], LiveFrames] = WeakValueDictionary()
        self._recent: deque[LiveFrames] = deque(maxlen=_KEPT_CHOICES)
        self.has_new_frames = False
        """Whether there are frames for clients that were not there when this was set to False."""
        self.set_parameters(b"", Parameters())

    def set_parameters(self, xml: bytes, parsed: Parameters) -> None:
        """Serve these parameters from now on; ``xml`` is empty if the server gives none."""
        self._xml = xml
        self._parsed = parsed
        self._announced_hz: Mapping[ComponentType, float] = {
            component: rate_hz
            for component in WIRE_ORDER
            if num_described_items(parsed, component)
            and (rate_hz := described_rate_hz(parsed, component)) is not None
        }
        self._xml_of = lru_cache(_CACHED_SECTIONS)(partial(cut_sections, xml, parsed))

    def add(self, frame: RawFrame, stream: int, wanted: frozenset[ComponentType], elapsed_us: int) -> bool:
        """Add a frame that arrives now on this stream; return whether it has ``wanted`` components."""
        return self._arrivals.add(frame, stream, wanted, elapsed_us) is not None

    def forget_frames(self) -> None:
        """Forget the frames so far, because none are added any more while no client asks for any."""
        self._arrivals.frames.clear()
        self._recent.clear()
        for frames in list(self._frames.values()):
            frames.forget()

    @property
    def newest_us(self) -> int:
        """When the newest frame arrived, on the clock of the measurement; -1 before the first."""
        return self._arrivals.newest_us

    @property
    def parameters(self) -> Parameters:
        """See Scene."""
        return self._parsed

    def parameters_xml(self, sections: Sequence[str], general: General) -> bytes:  # noqa: ARG002 - its own
        """See Scene. General is that of the source's server.

        Raises CommandError if its server gives no parameters.
        """
        if not self._xml:
            raise CommandError(f"The server of source {self._source} has given no parameters")
        return self._xml_of(frozenset(sections))

    def start(self) -> None:
        """See Scene."""
        self.stop()

    def advance(self, elapsed_us: int) -> int | None:
        """See Scene. It takes new frames for all that clients ask for."""
        due_us: int | None = None
        for frames in list(self._frames.values()):
            next_frame = frames.next_frame
            its_due_us = frames.update(elapsed_us)
            self.has_new_frames = self.has_new_frames or frames.next_frame != next_frame
            if its_due_us is not None and (due_us is None or its_due_us < due_us):
                due_us = its_due_us
        return due_us

    def stop(self) -> None:
        """See Scene."""
        self._arrivals.restart()
        self._frames.clear()
        self._recent.clear()

    def frames(self, components: Sequence[ComponentType], event_bytes: int = 24) -> LiveFrames:  # noqa: ARG002
        """See Scene. Events have the size in which they arrive."""
        choice = frozenset(components)
        frames = self._frames.get(choice)
        if frames is None:
            frames = self._frames[choice] = LiveFrames(components, self._arrivals, self._announced_hz)
            self._recent.append(frames)
        return frames
