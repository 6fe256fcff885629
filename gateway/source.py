"""One source: its streams' supervisors, the fan-out that they share, and the desk that answers for it."""

import asyncio
import logging
import math
from collections.abc import Callable
from typing import Any, Final

from gateway.c3d_spool import Spool
from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import LinkError, QueryError, SpoolError
from gateway.log import log_fields
from gateway.monitoring.status_line import source_line
from gateway.publish.fan_out import FanOut
from gateway.publish.status_messages import clock_message, status_message
from gateway.queries.answers import C3D, Answer
from gateway.queries.source_queries import Ask, SourceQueries, StreamAccess
from gateway.rtc3d.parameters_xml import ParsedParameters
from gateway.stream.state import StreamState
from gateway.stream.status import FrameRate, StreamStatus
from gateway.stream.supervisor import Callbacks, Supervisor

_MAX_WRITING: Final = 4
"""How many C3D files may wait in memory for the disk; more are dropped and told."""

logger = logging.getLogger(__name__)


class Source:
    """Everything of one source, which publishes by ``fan_out``.

    ``tell_parameters`` is called with the XML of every connection and whenever it changes, ``tell_file``
    with the description of every C3D file that was kept. ``before`` is the one that this one takes over
    from, fan-out and all, when the configuration has changed: the numbers go on.
    """

    def __init__(
        self,
        source: SourceSettings,
        fan_out: FanOut,
        spool: Spool,
        tell_parameters: Callable[[str, bytes], None],
        tell_file: Callable[[str, dict[str, Any]], None],
        before: "Source | None" = None,
    ) -> None:
        self.source = source
        self.spool = spool
        self.fan_out = fan_out
        self.fan_out.on_items_changed = self._ask_parameters_again
        session = 0 if before is None else max(status.session for status in before.statuses)
        self.statuses: list[StreamStatus] = [self._new_status(stream, session) for stream in source.streams]
        self.supervisors = [
            Supervisor(source, stream, status, self._callbacks(stream))
            for stream, status in zip(source.streams, self.statuses, strict=True)
        ]
        self.desk = SourceQueries(
            source,
            [
                StreamAccess(stream.components, status, _asker(supervisor))
                for stream, status, supervisor in zip(
                    source.streams, self.statuses, self.supervisors, strict=True
                )
            ],
            lambda: self.fan_out.newest,
            lambda: self._newest_status,
            self._last_c3d,
            self._record,
            self._on_change,
        )
        self._tell_parameters = tell_parameters
        self._tell_file = tell_file
        self._rates = [FrameRate() for _ in source.streams]
        self._rates_hz = [0.0 for _ in source.streams]
        self._tasks: set[asyncio.Task[None]] = set()
        self._num_writing = 0
        self._asks_again = False
        self.sequence: int = 0 if before is None else before.sequence
        """Of the newest status and clock message."""
        self._newest_status: bytes = self._status()

    async def run(self) -> None:
        """Keep every stream going until cancelled; then say Bye to the server."""
        try:
            async with asyncio.TaskGroup() as tasks:
                for supervisor in self.supervisors:
                    tasks.create_task(supervisor.run())
        finally:
            for task in self._tasks:
                task.cancel()

    @property
    def line(self) -> str:
        """How the source is, in one line for people; rates are those of the last ``publish_status``."""
        return source_line(self.source, list(zip(self.statuses, self._rates_hz, strict=True)))

    def publish_status(self) -> None:
        """Publish what ``status_t`` holds of this source; called once a second."""
        self.sequence += 1
        self._newest_status = self._status()
        # One server has one clock: the stream that knows it best tells it.
        best = min(self.statuses, key=_uncertainty_us)
        clock = clock_message(self.desk.session, self.sequence, best)
        with log_fields(source=self.source.name):
            self.fan_out.publish_status(self._newest_status)
            self.fan_out.publish_clock(clock.encode())

    def _status(self) -> bytes:
        self._rates_hz = [
            rate.update(status.frames_in) for rate, status in zip(self._rates, self.statuses, strict=True)
        ]
        message = status_message(
            source=self.source.name,
            server=f"{self.source.host}:{self.source.port}",
            sequence=self.sequence,
            streams=list(zip(self.statuses, self._rates_hz, strict=True)),
            outputs=[(status, output.health()) for output, status in self.fan_out.outputs],
        )
        encoded: bytes = message.encode()
        return encoded

    def _new_status(self, stream: StreamSettings, session: int) -> StreamStatus:
        components = " ".join(component.key for component in stream.components)
        name = f"{self.source.name} ({components})"
        return StreamStatus(components, name=name, on_state=self._on_state, session=session)

    def _on_state(self, _state: StreamState) -> None:
        flowing = any(status.state is StreamState.STREAMING for status in self.statuses)
        self.fan_out.show_flowing(flowing)

    def _callbacks(self, stream: StreamSettings) -> Callbacks:
        wanted = frozenset(stream.components)

        def on_parameters(xml: bytes, parsed: ParsedParameters) -> None:
            self.fan_out.set_parameters(parsed.parameters)
            self.desk.learn(xml, parsed)
            self._tell_parameters(self.source.name, xml)

        return Callbacks(
            publish=self.fan_out.publish,
            on_parameters=on_parameters,
            on_connected=lambda: self._start(self.desk.fill()),
            on_restart=self._ask_parameters_again,
            on_file=self._on_file,
            has_subscribers=lambda: self.fan_out.listened(wanted),
        )

    def _on_change(self, xml: bytes, parsed: ParsedParameters) -> None:
        """The server says other parameters than it did: tell, and ask for each section anew."""
        self.fan_out.set_parameters(parsed.parameters)
        self._tell_parameters(self.source.name, xml)
        self._start(self.desk.fill())

    def _ask_parameters_again(self) -> None:
        """The scene may have changed: ask once the server may be asked again; who listens is told."""
        if not self._asks_again:
            self._asks_again = True
            self._start(self._refresh())

    async def _refresh(self) -> None:
        try:
            await asyncio.sleep(self.source.fresh_interval_s)
            await self.desk.parameters((), fresh=True, stale_ok=False)
        except QueryError as error:
            logger.debug("%s: parameters not asked again: %s", self.source.name, error)
        finally:
            self._asks_again = False

    def _start(self, work: Any) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _on_file(self, content: bytes) -> None:
        if self._num_writing >= _MAX_WRITING:
            logger.error(
                "%s: a C3D file of %d bytes is not kept: %d before it are still being written; "
                "is the disk slow, or the server faulty?",
                *(self.source.name, len(content), self._num_writing),
            )
            return
        self._num_writing += 1
        self._start(self._keep(content))

    async def _keep(self, content: bytes) -> None:
        try:
            path = await asyncio.to_thread(self.spool.store, self.source.name, content)
        except SpoolError as error:
            logger.error("%s: %s", self.source.name, error)  # noqa: TRY400 - the sentence says it all
            return
        finally:
            self._num_writing -= 1
        logger.info(
            "%s: the server sent a C3D file of %d bytes, kept as %s", self.source.name, len(content), path
        )
        self._tell_file(self.source.name, {"name": path.name, "bytes": len(content)})

    async def _last_c3d(self) -> Answer:
        path = await asyncio.to_thread(self.spool.newest, self.source.name)
        if path is None:
            raise QueryError(f"source {self.source.name!r} has sent no C3D file so far", code="nothing-yet")
        try:
            content = await asyncio.to_thread(path.read_bytes)
        except OSError as error:
            raise QueryError(f"{path.name} cannot be read: {error.strerror}", code="nothing-yet") from error
        return Answer(content, C3D, {"name": path.name, "bytes": len(content)})

    def _record(self, start: bool) -> bool:
        for supervisor in self.supervisors:
            if supervisor.session is not None:
                try:
                    supervisor.session.control_recording(start=start)
                except LinkError:
                    continue
                return True
        return False


def _asker(supervisor: Supervisor) -> Callable[[], Ask | None]:
    def ask() -> Ask | None:
        return None if supervisor.session is None else supervisor.session.ask

    return ask


def _uncertainty_us(status: StreamStatus) -> float:
    return status.clock.uncertainty_us if status.clock.has_clock else math.inf
