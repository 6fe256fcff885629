"""Keeps one stream of one source running: connects, streams, and reconnects after every failure."""

import asyncio
import logging
import random
import time
from collections.abc import Callable, Collection, Sequence
from typing import Final, NamedTuple, NoReturn

from gateway.config.settings import ReconnectSettings, SourceSettings, StreamSettings
from gateway.errors import DefectError, LinkError
from gateway.messages.host_time import host_clock
from gateway.rtc3d.commands import StreamFrames
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.runtime.failures import log_fields
from gateway.session.backlog import ReadClocks
from gateway.session.ingest import Ingest, Publish, Skip
from gateway.session.rate_check import AnnouncedRates, RateWatch
from gateway.session.replies import ReadParameters
from gateway.session.session import FileSink, Session, defect_error
from gateway.session.state import StreamState
from gateway.session.status import StreamStatus
from gateway.session.stream_requests import StreamRequests, StreamTarget
from gateway.session.tcp import Connect, open_connection

logger = logging.getLogger(__name__)


class Callbacks(NamedTuple):
    """The functions that a stream calls, in the event loop. They must not block."""

    publish: Publish
    """Takes a frame to publish."""
    skip: Skip
    """Takes a frame that is not published because frames are late."""
    read_parameters: ReadParameters
    """Returns the server's parameters for each handshake."""
    on_restart: Callable[[], None]
    """Called when the server's frame numbers or time stamps start again within a connection."""
    files: FileSink
    """Takes the C3D files."""
    has_subscribers: Callable[[Collection[ComponentType]], bool]
    """Returns whether any of these components may have subscribers."""


class Listener:
    """Follows the connections of streams, and may change their components. This one does nothing."""

    def planning(self, stream: "Supervisor", parameters: Parameters | None) -> None:
        """Called in each handshake before frames are requested; ``parameters`` is None if there are none."""

    def connected(self, stream: "Supervisor", request: StreamFrames) -> None:
        """Called when the server has accepted ``request``, one of the forms of the request for frames."""

    def ended(self, stream: "Supervisor", error: LinkError) -> None:
        """Called when a connection ended, or could not be made."""


STEADY_S: Final = 10.0
"""A connection with data that lasted this long has succeeded: the delays start again."""

_MAX_DOUBLINGS: Final = 30


class Backoff:
    """The delays between attempts: doubling up to a maximum, each shortened at random by up to half.

    The randomness prevents many gateways from reconnecting to a restarted server at the same moment.

    A connection that brings data and lasts for STEADY_S starts the delays again. One that breaks earlier
    counts as a failure. So a server that sends a few good frames and breaks, again and again, is tried as
    rarely as one that is off. There is one exception: the delays that have grown while a server was off start
    again with the first data. So a server that comes back and is restarted once more is not kept waiting.
    """

    def __init__(self, reconnect: ReconnectSettings) -> None:
        self._first_s = reconnect.first_delay_s
        self._max_s = reconnect.max_delay_s
        self._num_failures = 0  # attempts in a row without data
        self._num_breaks = 0  # connections in a row with data, but not for STEADY_S

    @property
    def shortest_s(self) -> float:
        """A first delay, shortened at random."""
        return self._shortened(self._first_s)

    def delay_after(self, lasted_s: float, *, had_data: bool) -> float:
        """Return the delay after an attempt that lasted so long, and brought data or not."""
        if not had_data:
            self._num_failures += 1
        elif lasted_s < STEADY_S:
            self._num_failures = 0
            self._num_breaks += 1
        else:
            self._num_failures = 1
            self._num_breaks = 0
        doublings = min(self._num_failures + self._num_breaks - 1, _MAX_DOUBLINGS)
        return self._shortened(min(self._first_s * 2.0**doublings, self._max_s))

    @staticmethod
    def _shortened(delay_s: float) -> float:
        return delay_s * random.uniform(0.5, 1.0)  # noqa: S311 - spreads load, hides nothing


class Supervisor:
    """Runs the sessions of one stream, one after the other.

    ``connect`` and ``read_clocks`` are passed on to each Session. ``listener`` follows their connections.
    """

    def __init__(
        self,
        source: SourceSettings,
        stream: StreamSettings,
        status: StreamStatus,
        callbacks: Callbacks,
        listener: Listener | None = None,
        connect: Connect = open_connection,
        read_clocks: ReadClocks = host_clock.read,
    ) -> None:
        self._source = source
        self.settings = stream
        """The settings of the stream, with its present components."""
        self.status = status
        self.frame_rate = FrameRate()
        self._rate_watch = RateWatch(status)
        self._callbacks = callbacks
        self._connect = connect
        self._read_clocks = read_clocks
        self._listener = listener or Listener()
        self._ready_session: Session | None = None  # the newest session with a completed handshake
        self._ingest: Ingest | None = None  # of the newest session, like _target
        self._target: StreamTarget | None = None
        self._log_fields: dict[str, str] = {}

    @property
    def session(self) -> Session | None:
        """The open session with a completed handshake, for further commands; None if there is none."""
        session = self._ready_session
        return session if session is not None and session.is_open else None

    def change_components(self, components: tuple[ComponentType, ...]) -> None:
        """Stream these components from now on; an open connection requests them at once."""
        if components == self.settings.components:
            return
        self.settings = self.settings.model_copy(update={"components": components})
        status, is_open = self.status, self.session is not None
        status.components = self._log_fields["stream"] = component_keys(components)
        status.name = stream_name(self._source, components)
        if is_open:  # components that move to an open connection get a new session number there
            status.session = status.sessions.next_after(status.session)
        if self._ingest is not None:
            self._ingest.want(components)
        if is_open and self._target is not None:
            self._target.request_components(components)

    def check_rate(self, announced_hz: AnnouncedRates, *, reports_sharing: bool) -> None:
        """Report frames that arrive at another rate than requested or announced. Call it once a second."""
        if self.session is not None and self._ingest is not None and self._target is not None:
            self._rate_watch.check(
                self.settings,
                announced_hz,
                self._ingest.arrivals,
                self._read_clocks()[1] / 1e6,
                is_full_rate=self._target.is_full_rate,
                reports_sharing=reports_sharing,
            )

    async def run(self) -> None:
        """Keep the stream running until cancelled; then send Bye.

        The rule for errors: after any failure of a connection (LinkError), reconnect, without a limit,
        because a motion-capture computer that is off today is on tomorrow. Any other exception is a defect
        in this program. It is logged as an error, and also ends only the connection: other streams and
        sources continue.
        """
        server = f"{self._source.host}:{self._source.port}"
        with log_fields(source=self._source.name, stream=self.status.components, peer=server) as fields:
            self._log_fields = fields
            status, loop = self.status, asyncio.get_running_loop()
            backoff = Backoff(self._source.reconnect)
            while True:
                frames_before = status.frames_in
                began_s = loop.time()
                error = await self._run_session_to_its_end()
                had_data = status.frames_in > frames_before or status.state is StreamState.NO_MEASUREMENT
                status.disconnected(error)
                self._listener.ended(self, error)
                # The time that the attempt took counts as waiting. Otherwise a server that hung for long and
                # has recovered would wait for its client even longer.
                lasted_s = loop.time() - began_s
                is_defect = isinstance(error, DefectError)
                delay_s = backoff.delay_after(lasted_s, had_data=had_data and not is_defect)
                await asyncio.sleep(max(delay_s - lasted_s, backoff.shortest_s))
                status.reconnects += 1

    async def _run_session_to_its_end(self) -> LinkError:
        """Run one session; return why it ended. Raises CancelledError if the stream is cancelled."""
        try:
            await self._run_session()
        except LinkError as error:
            return error
        except (Exception, asyncio.CancelledError) as defect:  # noqa: BLE001 - ends only this connection
            # A defect in one stream must not stop the others. One that happens while a session is closed must
            # not replace the CancelledError, or the stream would never end. A CancelledError that nobody
            # asked for, of something that the session waited for, is a defect.
            task = asyncio.current_task()
            if task is not None and task.cancelling():
                if isinstance(defect, Exception):
                    self.status.defect(defect)
                raise asyncio.CancelledError from None
            return defect_error(defect)

    async def _run_session(self) -> NoReturn:
        """Run one session until it ends; raise LinkError with the reason."""
        common, callbacks = (self._source, self.settings, self.status), self._callbacks
        ingest = self._ingest = Ingest(
            *common,
            callbacks.publish,
            callbacks.skip,
            lambda halvings: target.lateness_changed(halvings),  # noqa: PLW0108 - assigned below
            callbacks.on_restart,
        )
        session = Session(*common, ingest.receive, callbacks.files, self._connect, self._read_clocks)
        requests = StreamRequests(*common, session, callbacks.read_parameters, self._planned_components)
        target = self._target = StreamTarget(
            *common, session, requests, lambda: callbacks.has_subscribers(self.settings.components)
        )
        try:
            await session.connect()
            await requests.start()
            self._listener.connected(self, requests.accepted)
            self._ready_session = session
            if set(requests.accepted.components) not in (set(), set(self.settings.components)):
                target.request_components(self.settings.components)  # they changed in the meantime
            target.start()
            await session.monitor(requests.check_silence)
        finally:
            target.cancel()
            await session.close()

    def _planned_components(self, parameters: Parameters | None) -> tuple[ComponentType, ...]:
        """Return the components to request from a server with these parameters."""
        self._listener.planning(self, parameters)
        return self.settings.components


class FrameRate:
    """The frame rate between two calls of ``update``."""

    def __init__(self) -> None:
        self._frames = 0
        self._time_s = time.monotonic()
        self.rate_hz = 0.0
        """The rate at the last call of ``update``."""

    def update(self, frames: int) -> float:
        """Return the mean rate in Hz since the last call; ``frames`` is the number of frames so far."""
        now_s = time.monotonic()
        elapsed_s = now_s - self._time_s
        self.rate_hz = (frames - self._frames) / elapsed_s if elapsed_s > 0 else 0.0
        self._frames, self._time_s = frames, now_s
        return self.rate_hz


def component_keys(components: Sequence[ComponentType]) -> str:
    """Return for example "3d 6d"."""
    return " ".join(component.key for component in components)


def stream_name(source: SourceSettings, components: Sequence[ComponentType]) -> str:
    """Return the name of a stream in log messages, for example "lab (3d 6d)"."""
    return f"{source.name} ({component_keys(components)})"
