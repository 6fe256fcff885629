"""One source: its streams' supervisors, the fan-out that they share, and the desk that answers for it."""

import asyncio
import logging
import math
from collections.abc import Callable, Collection, Sequence
from typing import Any

from gateway.config import Source, Stream
from gateway.errors import LinkError, QueryError, SpoolError
from gateway.fanout import FanOut
from gateway.outputs.contract import Output
from gateway.queries.answers import C3D, Answer
from gateway.queries.desk import Ask, Desk, StreamAccess
from gateway.rtc3d.parameters_xml import ParsedParameters
from gateway.spool import Spool
from gateway.status import FrameRate, StreamStatus, clock_message, status_message
from gateway.stream_state import StreamState
from gateway.supervisor import Callbacks, Supervisor

logger = logging.getLogger(__name__)


class SourceGateway:
    """Everything of one source.

    ``tell_parameters`` is called with the XML of every connection, ``tell_file`` with the description
    of every C3D file that was kept.
    """

    def __init__(
        self,
        source: Source,
        outputs: Sequence[Output],
        tool_outputs: Collection[str],
        spool: Spool,
        tell_parameters: Callable[[str, bytes], None],
        tell_file: Callable[[str, dict[str, Any]], None],
    ) -> None:
        self.source = source
        self.fan_out = FanOut(source.name, outputs, tool_outputs, self._ask_parameters_again)
        self.statuses = [self._new_status(stream) for stream in source.streams]
        self.supervisors = [
            Supervisor(source, stream, status, self._callbacks(stream))
            for stream, status in zip(source.streams, self.statuses, strict=True)
        ]
        self.desk = Desk(
            source,
            [
                StreamAccess(stream.components, status, _asker(supervisor))
                for stream, status, supervisor in zip(
                    source.streams, self.statuses, self.supervisors, strict=True
                )
            ],
            self.fan_out.newest,
            lambda: self._newest_status,
            self._last_c3d,
            self._record,
        )
        self._spool = spool
        self._tell_parameters = tell_parameters
        self._tell_file = tell_file
        self._rates = [FrameRate() for _ in source.streams]
        self._tasks: set[asyncio.Task[None]] = set()
        self._asks_again = False
        self._sequence = 0  # of status and clock messages
        self._newest_status = self._status()

    def publish_status(self) -> None:
        """Publish what ``status_t`` holds of this source; called once a second."""
        self._sequence += 1
        self._newest_status = self._status()
        self.fan_out.publish_status(self._newest_status)
        # One server has one clock: the stream that knows it best tells it.
        best = min(self.statuses, key=_uncertainty_us)
        clock = clock_message(self.desk.session, self._sequence, best)
        self.fan_out.publish_clock(clock.encode())

    def close(self) -> None:
        """Give up what is under way besides the supervisors."""
        for task in self._tasks:
            task.cancel()

    def _status(self) -> bytes:
        rates_hz = [
            rate.update(status.frames_in) for rate, status in zip(self._rates, self.statuses, strict=True)
        ]
        message = status_message(
            source=self.source.name,
            server=f"{self.source.host}:{self.source.port}",
            sequence=self._sequence,
            streams=list(zip(self.statuses, rates_hz, strict=True)),
            outputs=[(status, output.health()) for output, status in self.fan_out.outputs],
        )
        encoded: bytes = message.encode()
        return encoded

    def _new_status(self, stream: Stream) -> StreamStatus:
        components = " ".join(component.key for component in stream.components)
        return StreamStatus(components, name=f"{self.source.name} ({components})", on_state=self._on_state)

    def _on_state(self, _state: StreamState) -> None:
        flowing = any(status.state is StreamState.STREAMING for status in self.statuses)
        self.fan_out.show_flowing(flowing)

    def _callbacks(self, stream: Stream) -> Callbacks:
        wanted = frozenset(stream.components)

        def on_parameters(xml: bytes, parsed: ParsedParameters) -> None:
            self.fan_out.set_parameters(parsed.parameters)
            self.desk.learn(xml, parsed)
            self._tell_parameters(self.source.name, xml)

        def on_connected() -> None:
            for component in wanted:
                self.fan_out.newest.pop(component, None)  # what an earlier connection sent is not current
            self._start(self.desk.fill())

        return Callbacks(
            publish=self.fan_out.publish,
            parameters=on_parameters,
            connected=on_connected,
            restarted=self._ask_parameters_again,
            file=lambda content: self._start(self._keep(content)),
            listened=lambda: self.fan_out.listened(wanted),
        )

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

    async def _keep(self, content: bytes) -> None:
        try:
            path = await asyncio.to_thread(self._spool.store, self.source.name, content)
        except SpoolError as error:
            logger.error("%s: %s", self.source.name, error)  # noqa: TRY400 - the sentence says it all
            return
        logger.info(
            "%s: the server sent a C3D file of %d bytes, kept as %s", self.source.name, len(content), path
        )
        self._tell_file(self.source.name, {"name": path.name, "bytes": len(content)})

    async def _last_c3d(self) -> Answer:
        path = await asyncio.to_thread(self._spool.newest, self.source.name)
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
                    supervisor.session.record(start=start)
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
