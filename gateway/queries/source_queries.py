"""Answers to questions about one source, from caches where possible.

The server gets one question at a time. Peers that ask the same question meanwhile share its answer, and for
``fresh_interval_s`` after it a ``fresh`` question does not reach the server again.
"""

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Coroutine, Hashable, Mapping, Sequence
from typing import Any, Final, NamedTuple, TypeVar

from gateway.config.settings import SourceSettings
from gateway.errors import (
    FrameError,
    LinkError,
    QueryError,
    ReplyTimeoutError,
    ServerError,
)
from gateway.messages.host_time import now_utime
from gateway.messages.splice import FINGERPRINT_BYTES, splice
from gateway.messages.stamp import PREFIX, Stamp
from gateway.outputs.contract import Answer
from gateway.outputs.encodings import JSON, XML, json_bytes
from gateway.queries.answers import message_answer, schema_answer
from gateway.queries.parameter_cache import CachedParameters, Sections, parse_answer
from gateway.queries.questions import Question
from gateway.rtc3d.commands import Command, SendCurrentFrame, SendParameters
from gateway.rtc3d.components import COMPONENTS_BY_KEY, Component, ComponentType
from gateway.rtc3d.frames import detect_byte_order, split_frame
from gateway.rtc3d.packets import Packet, PacketType
from gateway.rtc3d.parameters import SECTIONS
from gateway.rtc3d.parameters_xml import ParsedParameters
from gateway.stream.state import StreamState
from gateway.stream.status import StreamStatus

NOT_PUBLISHED: Final = -1
"""The sequence number of a frame that a peer asked for and that is not part of the stream."""

LONG_XML_BYTES: Final = 64 * 1024
"""Longer XML is parsed in a thread: 1 MiB of it, made to be slow, takes 4 s."""

SendCommand = Callable[[Command], Awaitable[Packet]]
"""Sends a command to the server and returns its reply; raises ServerError, ReplyTimeoutError or LinkError."""

_Result = TypeVar("_Result")

logger = logging.getLogger(__name__)


class StreamAccess(NamedTuple):
    """One stream, for questions: ``sender`` returns None while there is no connection."""

    components: Sequence[ComponentType]
    status: StreamStatus
    sender: Callable[[], SendCommand | None]


class _Refusal(NamedTuple):
    """The server's refusal of a question about parameters."""

    text: str
    session: int
    received_s: float


class SourceQueries:
    """Answers questions about one source.

    ``newest_messages`` returns the newest message of each component. ``last_c3d`` raises QueryError if there
    is none. ``record`` starts (True) or stops a recording, and returns False if there is no connection for
    it. ``on_change`` is called with all parameters when the server's parameters differ from before.
    """

    def __init__(
        self,
        source: SourceSettings,
        streams: Sequence[StreamAccess],
        newest_messages: Callable[[], Mapping[ComponentType, bytes]],
        status_message: Callable[[], bytes],
        last_c3d: Callable[[], Coroutine[Any, Any, Answer]],
        record: Callable[[bool], bool],
        on_change: Callable[[bytes, ParsedParameters], None],
    ) -> None:
        self.source = source
        self.components = frozenset(kind for stream in streams for kind in stream.components)
        self._streams = streams
        self._newest_messages = newest_messages
        self._status_message = status_message
        self._last_c3d = last_c3d
        self._record = record
        self._on_change = on_change
        self._cached: dict[Sections, CachedParameters] = {}
        self._refusals: dict[Sections, _Refusal] = {}
        self._session_without_sections: int | None = None  # whose server does not send single sections
        self._pending: dict[Hashable, asyncio.Task[Any]] = {}
        self._server_lock = asyncio.Lock()

    async def answer(self, question: Question) -> Answer:
        """Return the answer; raises QueryError at the latest after query_timeout_s."""
        match question.kind:
            case "parameters":
                return await self._parameters(question)
            case "component":
                return await self._component(question)
            case "status":
                return message_answer(self._status_message(), question, {})
            case "schema":
                return schema_answer(question.name)
            case "c3d":
                return await self._shared("c3d", self._last_c3d)
            case "recording":
                return self._recording(question)

    def cache_parameters(self, xml: bytes, parsed: ParsedParameters) -> None:
        """Cache all parameters, as the server sent them at the start of a connection."""
        self._cached[()] = CachedParameters((), xml, parsed, self.session)

    @property
    def parameters_xml(self) -> bytes | None:
        """All parameters as the server last sent them; None before the first time."""
        cached = self._cached.get(())
        return None if cached is None else cached.xml

    async def parameters(self, sections: Sections, *, fresh: bool, stale_ok: bool) -> CachedParameters:
        """Return the server's answer for some sections, () for all: from the cache, or from the server.

        The answer of an earlier connection is returned only while there is none, and only if ``stale_ok``.
        Raises QueryError.
        """
        cached = self._cached.get(sections)
        if self._first_sender() is None:
            if cached is None or not stale_ok:
                raise QueryError(self.connection_problem(), code="no-connection")
            return cached
        if cached is not None and self._is_valid(cached, fresh=fresh):
            return cached
        refusal = self._refusals.get(sections)
        if refusal is not None and self._is_valid(refusal, fresh=fresh):
            raise QueryError(refusal.text, code="refused")
        return await self._shared(("parameters", sections), lambda: self._ask_parameters(sections))

    async def fill_cache(self) -> None:
        """Ask for each section, so that the cache has the server's answer to every question.

        Do nothing if the server did not send its parameters at the start of the connection.
        """
        everything = self._cached.get(())
        if everything is None or everything.session != self.session:
            return
        for section in SECTIONS:
            try:
                await self.parameters((section,), fresh=False, stale_ok=False)
            except QueryError as error:
                logger.debug("%s: section %s is not available: %s", self.source.name, section, error)
                if error.code != "refused":
                    return

    def connection_problem(self) -> str:
        """Return why there is no connection, since when, and what to do about it."""
        newest = max((stream.status for stream in self._streams), key=lambda status: status.last_error_utime)
        where = f"source {self.source.name!r} has no connection"
        if not newest.last_error:
            return f"{where} yet: connecting to {self.source.host}:{self.source.port}"
        problem, separator, remedy = newest.last_error.partition("; ")
        age_s = (now_utime() - newest.last_error_utime) / 1e6
        return f"{where}: {problem.removeprefix('connection ')}, tried {age_s:.1f} s ago{separator}{remedy}"

    @property
    def session(self) -> int:
        """A number that grows with every connection of any stream."""
        return sum(stream.status.session for stream in self._streams)

    def _first_sender(self) -> SendCommand | None:
        senders = (stream.sender() for stream in self._streams)
        return next((sender for sender in senders if sender is not None), None)

    def _is_valid(self, answer: CachedParameters | _Refusal, *, fresh: bool) -> bool:
        """Return whether the answer came in this connection, and, for ``fresh``, just now."""
        if answer.session != self.session:
            return False
        return not fresh or time.monotonic() - answer.received_s < self.source.fresh_interval_s

    async def _ask_parameters(self, sections: Sections) -> CachedParameters:
        """Ask the server; ask for all parameters if it does not know sections."""
        session = self.session
        takes_sections = bool(sections) and self._session_without_sections != session
        commands = [SendParameters(sections), SendParameters()] if takes_sections else [SendParameters()]
        try:
            command, packet = await self._ask_server(self._first_sender, commands)
        except QueryError as error:
            if error.code == "refused":
                self._refusals[sections] = _Refusal(str(error), session, time.monotonic())
            raise
        if takes_sections and command != commands[0]:
            self._session_without_sections = session
        if len(packet.body) > LONG_XML_BYTES:
            answer = await asyncio.to_thread(parse_answer, sections, packet.body, session)
        else:
            answer = parse_answer(sections, packet.body, session)
        before, self._cached[sections] = self._cached.get(sections), answer
        if before is None or before.session != session or answer.comparable != before.comparable:
            self._parameters_changed(answer, before)
        return answer

    def _parameters_changed(self, answer: CachedParameters, before: CachedParameters | None) -> None:
        """Report changed parameters. If only a section was asked for, ask for all of them first."""
        if answer.sections:
            if before is not None and before.session == answer.session:
                self._task(("parameters", ()), lambda: self._ask_parameters(()))
        elif answer.parsed is not None:
            self._cached = {(): answer}  # every section has to be asked for again
            self._on_change(answer.xml, answer.parsed)

    async def _parameters(self, question: Question) -> Answer:
        sections = (question.name,) if question.name else ()
        cached = await self.parameters(sections, fresh=question.fresh, stale_ok=question.stale_ok)
        attachment: dict[str, Any] = {"age_s": round(cached.age_s, 3), "session": cached.session}
        if self._first_sender() is None:
            attachment["stale"] = True
        if not question.as_json:
            return Answer(cached.xml, XML, attachment)
        if cached.parsed is None:
            raise QueryError(
                "the server's XML cannot be read; ask without format=json to see it as received",
                code="unreadable",
            )
        if cached.json is None:
            raise QueryError(f"the server's answer has no section {question.name}", code="nothing-yet")
        return Answer(cached.json, JSON, attachment | {"recovered": list(cached.parsed.recovered)})

    async def _component(self, question: Question) -> Answer:
        kind = COMPONENTS_BY_KEY[question.name]
        stream = next(stream for stream in self._streams if kind in stream.components)
        session = stream.status.session
        if stream.sender() is None:
            raise QueryError(self.connection_problem(), code="no-connection")
        if stream.status.state is StreamState.STREAMING:
            message = self._newest_messages().get(kind)
            if message is None or _session_of(message) != session:
                raise QueryError(
                    f"no {question.name} has arrived from source {self.source.name!r} in this session",
                    code="nothing-yet",
                )
        else:
            component = await self._shared(("frame", kind), lambda: self._current_frame(kind, stream))
            utime = now_utime()
            message = splice(component, Stamp(utime, utime, session), NOT_PUBLISHED)
        return message_answer(message, question, {"session": session})

    async def _current_frame(self, kind: ComponentType, stream: StreamAccess) -> Component:
        """Ask for the current frame (§5.3.4), without a name if the server knows none (field note 2)."""
        _, packet = await self._ask_server(stream.sender, [SendCurrentFrame((kind,)), SendCurrentFrame()])
        if packet.type == PacketType.NO_DATA:
            raise QueryError(f"source {self.source.name!r}: no measurement runs", code="nothing-yet")
        try:
            frame = split_frame(packet.body, detect_byte_order(packet.body, self.source.byte_order))
        except FrameError as error:
            raise QueryError(f"the current frame cannot be read: {error}", code="unreadable") from error
        for component in frame.components:
            if component.type is kind:
                return component
        raise QueryError(f"the current frame has no {kind.key}", code="nothing-yet")

    def _recording(self, question: Question) -> Answer:
        if not self.source.remote_control:
            raise QueryError(
                f"recording control is off for source {self.source.name!r}; to switch it on, set "
                "remote_control: true for it in the gateway's configuration",
                code="refused",
            )
        if not question.set:
            raise QueryError("recording takes one option; accepted: set=start, set=stop")
        if not self._record(question.set == "start"):
            raise QueryError(self.connection_problem(), code="no-connection")
        return Answer(json_bytes({"source": self.source.name, "sent": question.set}), JSON)

    async def _ask_server(
        self, find_sender: Callable[[], SendCommand | None], commands: Sequence[Command]
    ) -> tuple[Command, Packet]:
        """Return the first of the commands that the server answers, and its answer.

        Raises QueryError, at the latest after query_timeout_s, including the wait for other questions.
        """
        name = f"source {self.source.name!r}"
        problem = QueryError(f"{name}: nothing to ask")
        try:
            async with asyncio.timeout(self.source.query_timeout_s), self._server_lock:
                for command in commands:
                    send = find_sender()
                    if send is None:
                        raise QueryError(self.connection_problem(), code="no-connection")
                    try:
                        return command, await send(command)
                    except ServerError as error:
                        text = f"the server does not know {command}, or refuses it: {error}"
                        problem = QueryError(f"{name}: {text}", code="refused")
                    except ReplyTimeoutError as error:
                        problem = QueryError(f"{name}: {error}", code="timeout")
        except LinkError as error:
            raise QueryError(f"{name} has just lost its connection: {error}", code="no-connection") from error
        except TimeoutError:
            waited = f"no answer within {self.source.query_timeout_s:g} s"
            text = f"{name}: {waited}; questions waiting for the server: {len(self._pending)}"
            raise QueryError(text, code="timeout") from None
        raise problem

    async def _shared(self, key: Hashable, work: Callable[[], Coroutine[Any, Any, _Result]]) -> _Result:
        """Return the result of ``work``, shared by everybody who asks for the same at the same time."""
        return await asyncio.shield(self._task(key, work))

    def _task(self, key: Hashable, work: Callable[[], Coroutine[Any, Any, _Result]]) -> asyncio.Task[_Result]:
        task = self._pending.get(key)
        if task is None:
            task = asyncio.create_task(work())
            task.add_done_callback(lambda done: self._finished(key, done))
            self._pending[key] = task
        return task

    def _finished(self, key: Hashable, task: asyncio.Task[Any]) -> None:
        del self._pending[key]
        if not task.cancelled():
            task.exception()  # retrieve it, even if every asker has gone


def _session_of(message: bytes) -> int:
    session: int = PREFIX.unpack_from(message, FINGERPRINT_BYTES)[3]
    return session
