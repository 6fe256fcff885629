"""One source: the supervisors of its streams, its fan-out, and the queries about it."""

import asyncio
import logging
import math
from collections.abc import Awaitable, Mapping, Sequence
from typing import Any, Final

import rtc3d

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import LinkError, QueryError, raise_unless_defect
from gateway.messages.decode import C3D
from gateway.messages.encode import NOT_PUBLISHED
from gateway.messages.source_report import SourceReport, source_report
from gateway.messages.texts import encode_within_limits
from gateway.outputs.contract import Answer, Output, ServerFile, ServerParameters
from gateway.publish.fan_out import FanOut
from gateway.publish.status_messages import clock_message, status_message
from gateway.queries.answers import FilePayload, QueryHistory, ServerAnswer
from gateway.queries.server_requests import ParameterRefresh, RecordingAccess, StreamAccess
from gateway.queries.service import SourceQueries
from gateway.rtc3d.components import only_components
from gateway.rtc3d.parameters import Parameters
from gateway.rtc3d.parameters_xml import ParsedParameters
from gateway.runtime.failures import HOLD_S, DefectLog, FailureLog, log_fields
from gateway.session.c3d_files.receiving import FileReceiver, SourceFiles
from gateway.session.c3d_files.spool import Spool, StoredFile
from gateway.session.replies import UNANSWERED, Connection
from gateway.session.state import StreamState
from gateway.session.status import SessionNumbers, SourceWarnings, StreamStatus
from gateway.session.streams import AutomaticStreams, ConfiguredStreams
from gateway.session.supervisor import Callbacks, Listener, Supervisor, component_keys, stream_name

_SENDING_TIMEOUT_S: Final = 0.5

logger = logging.getLogger(__name__)


class SourceHistory:
    """What a source continues when it is built again, after a reload or a defect."""

    def __init__(self, settings: SourceSettings, outputs: Sequence[Output]) -> None:
        self.settings = settings
        self.fan_out = FanOut(settings.name, outputs)
        self.defects: DefectLog = DefectLog(logger, settings.name)
        """The log of defects in handling this source."""
        self.sessions = SessionNumbers()
        """The numbers of the connections."""
        self.parameters_version = 0
        """The version of the server's parameters in published frames; 0 before the first."""
        self.sequence: int = NOT_PUBLISHED
        """The sequence number of the newest status and clock messages."""
        self.queries = QueryHistory(settings.name)


class Source:
    """Runs the streams of one source, publishes their data through ``fan_out``, and answers queries."""

    def __init__(self, settings: SourceSettings, history: SourceHistory, spool: Spool) -> None:
        # The names and units of the former server do not apply to another one, not even until its handshake.
        former = history.settings
        self._has_new_server = (former.host, former.port) != (settings.host, settings.port)
        self._has_new_frame = not former.has_frame_of(settings)
        self._has_new_components = former.components != settings.components
        history.settings = settings
        self.history = history
        self._warnings = SourceWarnings(settings.name)
        self.spool = spool
        self.fan_out = history.fan_out
        self.queries = SourceQueries(
            settings,
            lambda: [
                StreamAccess(stream.settings.components, stream.status, stream.session)
                for stream in self.streams
            ],
            published=self.fan_out,
            status_message=lambda: self._newest_status,
            last_c3d=self._last_c3d,
            recording=RecordingAccess(self._record, self._follow_recording),
            announce_parameters=self._announce_parameters,
            history=history.queries,
        )
        parameters = self.queries.parameters
        self._refresh = ParameterRefresh(settings, parameters.refresh, lambda: parameters.last_read_s)
        self.fan_out.on_items_changed = self._refresh.request
        self._files = SourceFiles(settings.name, lambda: self.spool, self._on_stored)
        self._spool_problems = FailureLog(logger, settings.name, HOLD_S)
        self._streams: ConfiguredStreams | AutomaticStreams = (
            AutomaticStreams(settings.stall_timeout_s, self._new_stream)
            if settings.streams == "auto"
            else ConfiguredStreams(settings.streams, self._new_stream)
        )
        self._failure: asyncio.Future[None] | None = None  # ends ``run``
        self._newest_status: bytes = encode_within_limits(self._status_message())

    @property
    def settings(self) -> SourceSettings:
        """The settings; ``change_frame`` replaces them."""
        return self.history.settings

    @property
    def name(self) -> str:
        """The source's name."""
        return self.settings.name

    @property
    def streams(self) -> Sequence[Supervisor]:
        """The streams: those of the configuration, or the present ones with ``streams: auto``."""
        return self._streams.streams

    @property
    def statuses(self) -> list[StreamStatus]:
        """The status of each stream."""
        return [stream.status for stream in self.streams]

    @property
    def report(self) -> SourceReport:
        """What this source's status says now; frame rates are those of the last ``publish_status``."""
        return source_report(self._status_message())

    async def run(self) -> None:
        """Run every stream until cancelled; then send Bye to the server.

        Raises any exception that is a defect, of the source or of a stream. The caller builds the source
        again, because the state of this one can no longer be trusted.
        """
        self._failure = asyncio.get_running_loop().create_future()
        if not self.known_parameters.version:
            self.fan_out.begin(self.known_parameters)
        if self._has_new_server:
            await self.queries.parameters.make_void("the configuration names another server")
        elif self._has_new_frame and self.known_parameters.version:
            await self.queries.parameters.begin_version()
        elif self._has_new_components and self.known_parameters.version:
            await self._publish_parameters()
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(asyncio.wait_for(self._failure, None))
                tasks.create_task(self._refresh.run())
                await self._streams.run()
                raise RuntimeError("the streams have ended, and nobody stopped them")
        finally:
            await self._files.finish()
            for stream in self._streams.known:
                stream.status.losses.close()

    async def change_frame(self, settings: SourceSettings) -> None:
        """Use ``settings``, which differ only in the frame of poses, and tell outputs. Streams continue."""
        self.history.settings = self.queries.settings = settings
        if self.known_parameters.version:
            await self.queries.parameters.begin_version()
        else:
            self.fan_out.begin(self.known_parameters)

    # Status.

    def fail(self, defect: Exception) -> None:
        """End ``run`` with this defect."""
        if self._failure is not None and not self._failure.done():
            self._failure.set_exception(defect)

    def show_restart(self, defect: str) -> None:
        """Show why this source was built again, until its streams are connected."""
        self.fan_out.show_streaming(False)
        for status in self.statuses:
            status.record_error(defect)

    def publish_status(self) -> None:
        """Check the streams, and publish the status and the clock of this source. Called once a second.

        A defect in checking the streams ends ``run``. One in publishing does not: the data is what matters.
        """
        with log_fields(source=self.name):
            self.history.sequence += 1
            try:
                self._streams.check()
            except Exception as defect:  # noqa: BLE001 - ``run`` raises it
                self.fail(defect)
            for work in (
                self._files.check,
                self._check_logs,
                self._publish_newest_status,
                self._publish_clock,
            ):
                try:
                    work()
                except BaseException as defect:  # noqa: BLE001 - the next status may succeed
                    raise_unless_defect(defect)
                    self.history.defects.log(defect)

    def _check_logs(self) -> None:
        for stream in self._streams.known:
            stream.status.check()
        self.fan_out.maintain()

    def _publish_newest_status(self) -> None:
        for stream in self.streams:
            stream.frame_rate.update(stream.status.frames_in)
        self._newest_status = encode_within_limits(self._status_message())
        self.fan_out.publish_status(self._newest_status)

    def _publish_clock(self) -> None:
        # One server has one clock: publish the best estimate of all streams.
        clocks = [(each.clock.uncertainty_us if each.clock.has_clock else math.inf) for each in self.statuses]
        best = self.statuses[clocks.index(min(clocks))]
        clock = clock_message(self.queries.session, self.history.sequence, best)
        self.fan_out.publish_clock(encode_within_limits(clock))

    def _status_message(self) -> rtc3d.status_t:
        return status_message(
            source=self.name,
            server=f"{self.settings.host}:{self.settings.port}",
            sequence=self.history.sequence,
            streams=[(stream.status, stream.frame_rate.rate_hz) for stream in self.streams],
            outputs=[
                (status, output.health(), (output.query_results or {}).get(self.name, {}))
                for output, status in self.fan_out.outputs
            ],
            stall_timeout_s=self.settings.stall_timeout_s,
            frame=self.queries.frame,
        )

    def _new_stream(self, stream: StreamSettings, listener: Listener) -> Supervisor:
        status = StreamStatus(
            component_keys(stream.components),
            name=stream_name(self.settings, stream.components),
            on_state=lambda former: self._on_state(status, former),
            session=self.history.sessions.newest,
            sessions=self.history.sessions,
            parameters_version=self.history.parameters_version,
            known_defects=self.history.defects,
            warnings=self._warnings,
        )
        callbacks = Callbacks(
            publish=self.fan_out.publish,
            skip=self.fan_out.skip,
            read_parameters=self._read_parameters,
            on_restart=self._refresh.request,
            files=FileReceiver(self._files, lambda error: status.file_lost(str(error))),
            has_subscribers=self.fan_out.has_subscribers,
        )
        return Supervisor(self.settings, stream, status, callbacks, listener)

    def _on_state(self, status: StreamStatus, former: StreamState) -> None:
        is_streaming = any(status.state is StreamState.STREAMING for status in self.statuses)
        self.fan_out.show_streaming(is_streaming)
        has_no_data = any(status.state is StreamState.NO_MEASUREMENT for status in self.statuses)
        self.fan_out.show_measurement(True if is_streaming else False if has_no_data else None)
        if status.state is StreamState.WAITING:
            self.fan_out.forget_layouts()
        if former is StreamState.NO_MEASUREMENT and status.state is StreamState.STREAMING:
            self._refresh.request()  # a new measurement may have other markers and tools

    # Parameters.

    @property
    def known_parameters(self) -> ServerParameters:
        """The newest parameters as the outputs get them; empty ones if the server gives none."""
        known = self.queries.parameters
        components = self.settings.components
        return ServerParameters(
            b"" if known.newest is None else known.newest.xml,
            *(self.queries.session, known.version),
            parsed=only_components(self._parsed, components),
            frame=self.queries.frame,
            components=components,
        )

    @property
    def _parsed(self) -> Parameters:
        newest = self.queries.parameters.newest
        return Parameters() if newest is None else newest.parsed.parameters

    def _read_parameters(self, connection: Connection) -> Awaitable[ParsedParameters]:
        return self.queries.parameters.read_for_handshake(connection)

    async def _publish_parameters(self) -> None:
        """Publish them on every output; wait until they have been sent, but at most _SENDING_TIMEOUT_S."""
        parameters = self.known_parameters
        sent = [output.publish_parameters(self.name, parameters) for output, _ in self.fan_out.outputs]
        pending = [future for future in sent if future is not None]
        if pending:
            await asyncio.wait(pending, timeout=_SENDING_TIMEOUT_S)

    async def _announce_parameters(self, answer: ServerAnswer | None, version: int) -> None:
        """Publish parameters, empty ones if the former are void; then mark the frames with their version."""
        try:
            await self._publish_parameters()
        finally:
            if version != self.history.parameters_version:
                self.history.parameters_version = version
                for stream in self._streams.known:
                    stream.status.parameters_version = version
                    if answer is not None:
                        stream.status.replace_limitation(UNANSWERED, "")
                self._streams.parameters_changed(self._parsed)
            self.fan_out.set_parameters(self.known_parameters)

    # C3D files and recordings.

    def _on_stored(self, stored: StoredFile) -> None:
        """Log and announce a file. It is there, even if old ones could not be deleted."""
        deleted = f"; deleted the oldest ({len(stored.deleted)})" if stored.deleted else ""
        logger.info(
            "%s: the server sent a C3D file of %d bytes, kept as %s%s",
            *(self.name, stored.num_bytes, stored.path, deleted),
        )
        if stored.problem:
            self._spool_problems.failed(f"old C3D files are not deleted: {stored.problem}")
        else:
            self._spool_problems.recovered("old C3D files can be deleted again")
        for output, _ in self.fan_out.outputs:
            try:
                output.announce_file(self.name, ServerFile(stored.path, stored.num_bytes))
            except BaseException as defect:  # noqa: BLE001 - a defect in an output must not stop the streams
                raise_unless_defect(defect)
                self.history.defects.log(defect)

    async def _last_c3d(self) -> Answer:
        spool, timeout_s = self.spool, self.settings.query_timeout_s

        def find() -> FilePayload | None:
            path = spool.newest(self.name)
            return None if path is None else FilePayload(path)

        try:
            async with asyncio.timeout(timeout_s):
                newest = await spool.reader.run(find)
        except TimeoutError:
            text = f"the disk of the gateway did not find the file within {timeout_s:g} s"
            raise QueryError(text, code="timeout") from None
        except OSError as error:
            text = f"the newest C3D file of source {self.name!r} cannot be read: {error.strerror}"
            raise QueryError(text, code="nothing-yet") from error
        if newest is None:
            raise QueryError(f"source {self.name!r} has sent no C3D file so far", code="nothing-yet")
        return Answer(newest, C3D, {"name": newest.name, "bytes": newest.num_bytes})

    def _record(self, start: bool) -> bool:
        for stream in self.streams:
            if stream.session is not None:
                try:
                    stream.session.control_recording(start=start)
                except LinkError:
                    continue
                return True
        return False

    async def _follow_recording(self, start: bool, name: str) -> Mapping[str, Any]:
        """Let the outputs follow a recording; return what they add to the reply to the peer."""
        reply: dict[str, Any] = {}
        for output, _ in self.fan_out.outputs:
            reply |= await output.follow_recording(self.name, start=start, name=name)
        return reply
