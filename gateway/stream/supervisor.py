"""Keeps one stream of one source going: connect, stream, and after every failure again, for ever."""

import asyncio
import logging
import random
from collections.abc import Callable, Coroutine, Iterator
from typing import Any, Final, NamedTuple

from gateway.config.settings import ReconnectSettings, SourceSettings, StreamSettings
from gateway.errors import LinkError
from gateway.log import FailureLog, log_fields
from gateway.rtc3d.parameters_xml import ParsedParameters
from gateway.stream.ingest import Ingest, Publish
from gateway.stream.session import Handlers, Session
from gateway.stream.state import StreamInput, StreamState
from gateway.stream.status import StreamStatus
from gateway.stream.stream_control import StreamControl

DEMAND_POLL_S: Final = 0.05
"""How often an on-demand stream looks for listeners: nothing depends on one notification."""

logger = logging.getLogger(__name__)


class Callbacks(NamedTuple):
    """Who is told what of one stream. Called from the event loop; they must not wait."""

    publish: Publish
    """Takes a frame to publish."""
    parameters: Callable[[bytes, ParsedParameters], None]
    """Takes the XML that a connection began with, as it came, and what it says."""
    connected: Callable[[], None]
    """Called when the handshake is done, and questions may be asked."""
    restarted: Callable[[], None]
    """Called when the server's frame numbers or time stamps begin anew within a connection."""
    file: Callable[[bytes], None]
    """Takes a complete C3D file."""
    listened: Callable[[], bool]
    """Says whether anybody may be listening to the stream's components."""


def backoff_delays_s(reconnect: ReconnectSettings) -> Iterator[float]:
    """Yield the waits between tries: doubling, capped, each between half and all of its length.

    The jitter keeps many gateways from coming back to a restarted server in step.
    """
    delay_s = reconnect.first_delay_s
    while True:
        yield delay_s * random.uniform(0.5, 1.0)  # noqa: S311 - spreads load, hides nothing
        delay_s = min(2 * delay_s, reconnect.max_delay_s)


class Supervisor:
    """Runs the sessions of one stream, one after the other."""

    def __init__(
        self,
        source: SourceSettings,
        stream: StreamSettings,
        status: StreamStatus,
        callbacks: Callbacks,
        delays_s: Callable[[ReconnectSettings], Iterator[float]] = backoff_delays_s,
    ) -> None:
        self._source = source
        self._stream = stream
        self._status = status
        self._callbacks = callbacks
        self._delays_s = delays_s
        self._failures = FailureLog(logger, status.name)
        self._session: Session | None = None
        self._ready = False
        self._changes: set[asyncio.Task[None]] = set()  # of the rate, under way

    @property
    def session(self) -> Session | None:
        """The session that questions can be asked of; None while there is none."""
        return self._session if self._ready and self._session is not None and self._session.is_open else None

    async def run(self) -> None:
        """Keep the stream going until cancelled; then say Bye.

        The rule: whatever goes wrong with a connection (LinkError) is tried again, without end,
        because a motion-capture computer that is off today is on tomorrow. Anything else is a
        mistake in this program and is raised.
        """
        server = f"{self._source.host}:{self._source.port}"
        with log_fields(source=self._source.name, stream=self._status.components, peer=server):
            await self._run_sessions()

    async def _run_sessions(self) -> None:
        delays_s = self._delays_s(self._source.reconnect)
        while True:
            frames_before = self._status.frames_in
            try:
                await self._run_session()
            except LinkError as error:
                self._status.note_error(str(error))
                self._failures.failed(str(error))
                if self._status.state is StreamState.NO_MEASUREMENT or self._status.frames_in > frames_before:
                    delays_s = self._delays_s(self._source.reconnect)
                self._status.move(StreamInput.ENDED, str(error))
            await asyncio.sleep(next(delays_s))
            self._status.reconnects += 1

    async def _run_session(self) -> None:
        """Run one session to its end, which is always a LinkError."""
        lateness = FailureLog(logger, self._status.name)
        intake = Ingest(
            self._source,
            self._stream,
            self._status,
            self._callbacks.publish,
            lambda halvings: self._change(self._follow_lag(negotiation, halvings, lateness)),
            self._callbacks.restarted,
        )
        session = Session(
            self._source,
            self._stream,
            self._status,
            Handlers(intake.take, self._callbacks.parameters, self._callbacks.file),
        )
        negotiation = StreamControl(self._source, self._stream, self._status, session)
        self._session = session
        try:
            await session.connect()
            await negotiation.start()
            self._status.move(StreamInput.READY, session.server)
            self._failures.recovered(f"streaming from {session.server}")
            self._ready = True
            self._callbacks.connected()
            if self._stream.on_demand:
                self._change(self._follow_demand(negotiation))
            await session.ended()
        finally:
            self._ready = False
            for task in self._changes:
                task.cancel()
            await session.close()

    def _change(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(self._guard(work))
        self._changes.add(task)
        task.add_done_callback(self._changes.discard)

    async def _guard(self, work: Coroutine[Any, Any, None]) -> None:
        try:
            await work
        except LinkError as error:
            logger.debug("%s: %s", self._status.name, error)  # the session ends, and says why

    async def _follow_lag(self, negotiation: StreamControl, halvings: int, lateness: FailureLog) -> None:
        lag_ms = 1000 * self._status.lag_s
        await negotiation.change_rate(halvings)
        asked = f"asked the server for {self._status.rate or 'its default rate'}"
        if lag_ms > self._source.max_lag_ms:
            lateness.failed(f"frames come {lag_ms:.0f} ms late; {asked}")
        elif halvings:
            logger.debug("%s: frames come in time; %s", self._status.name, asked)
        else:
            lateness.recovered(f"frames come in time; {asked}")

    async def _follow_demand(self, negotiation: StreamControl) -> None:
        """Stop the stream while nobody listens, and start it again within DEMAND_POLL_S of the first."""
        loop = asyncio.get_running_loop()
        last_listened_s = loop.time()
        running = True
        while True:
            if self._callbacks.listened():
                last_listened_s = loop.time()
                if not running:
                    logger.info("%s: somebody listens; streaming", self._status.name)
                    await negotiation.resume()
                    running = True
            elif running and loop.time() - last_listened_s >= self._stream.idle_after_s:
                logger.info("%s: nobody listens; the stream is stopped", self._status.name)
                await negotiation.pause()
                running = False
            await asyncio.sleep(DEMAND_POLL_S)
