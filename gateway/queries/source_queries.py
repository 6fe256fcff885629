"""Answers questions about one source, asking its server as little as can be.

One question to the server is under way at a time; peers that ask the same meanwhile share its answer,
and for ``fresh_interval_s`` after it nobody's ``fresh`` reaches the server again.
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
from gateway.queries.answers import (
    JSON,
    XML,
    Answer,
    Question,
    json_bytes,
    message_answer,
    schema_answer,
)
from gateway.queries.parameter_cache import Known, Sections, known_from
from gateway.rtc3d.commands import Command, SendCurrentFrame, SendParameters
from gateway.rtc3d.components import COMPONENTS_BY_KEY, Component, ComponentType
from gateway.rtc3d.frames import detect_byte_order, split_frame
from gateway.rtc3d.packets import Packet, PacketType
from gateway.rtc3d.parameters import SECTIONS
from gateway.rtc3d.parameters_xml import ParsedParameters
from gateway.stream.state import StreamState
from gateway.stream.status import StreamStatus

NOT_PUBLISHED: Final = -1
"""The sequence number of a frame that was asked for and is no part of the stream."""

LONG_XML_BYTES: Final = 64 * 1024
"""More than this is parsed in a thread: 1 MiB of it, made to be slow, takes 4 s."""

Ask = Callable[[Command], Awaitable[Packet]]
"""Sends a command over a connection; raises ServerError, ReplyTimeoutError or LinkError."""

_Result = TypeVar("_Result")

logger = logging.getLogger(__name__)


class StreamAccess(NamedTuple):
    """One stream as the desk sees it: ``ask`` gives None while there is no connection."""

    components: Sequence[ComponentType]
    status: StreamStatus
    ask: Callable[[], Ask | None]


class _Refusal(NamedTuple):
    """The server's no to a question about parameters."""

    text: str
    session: int
    came_s: float


class SourceQueries:
    """Answers questions about one source.

    ``newest`` returns the newest message of each component. ``last_c3d`` raises QueryError if there is
    none. ``record`` starts (True) or stops a recording, and gives False if no connection is there to do
    it. ``changed`` is called with all parameters when a server says something else than before.
    """

    def __init__(
        self,
        source: SourceSettings,
        streams: Sequence[StreamAccess],
        newest: Callable[[], Mapping[ComponentType, bytes]],
        status_message: Callable[[], bytes],
        last_c3d: Callable[[], Coroutine[Any, Any, Answer]],
        record: Callable[[bool], bool],
        changed: Callable[[bytes, ParsedParameters], None],
    ) -> None:
        self.source = source
        self.components = frozenset(kind for stream in streams for kind in stream.components)
        self._streams = streams
        self._newest = newest
        self._status_message = status_message
        self._last_c3d = last_c3d
        self._record = record
        self._changed = changed
        self._known: dict[Sections, Known] = {}
        self._refusals: dict[Sections, _Refusal] = {}
        self._whole_only: int | None = None  # the session whose server sends no single sections
        self._under_way: dict[Hashable, asyncio.Task[Any]] = {}
        self._server_is_asked = asyncio.Lock()

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

    def learn(self, xml: bytes, parsed: ParsedParameters) -> None:
        """Take the parameters that a connection began with."""
        self._known[()] = Known((), xml, parsed, self.session)

    @property
    def parameters_xml(self) -> bytes | None:
        """All parameters as the server last sent them; None if it has not so far."""
        known = self._known.get(())
        return None if known is None else known.xml

    async def parameters(self, sections: Sections, *, fresh: bool, stale_ok: bool) -> Known:
        """Return the server's answer for some sections, () for all: known already, or asked for now.

        What an earlier connection said is given only while there is none, and only if ``stale_ok``.
        Raises QueryError.
        """
        known = self._known.get(sections)
        if self._first_ask() is None:
            if known is None or not stale_ok:
                raise QueryError(self.connection_problem(), code="no-connection")
            return known
        if known is not None and self._still_counts(known, fresh=fresh):
            return known
        refusal = self._refusals.get(sections)
        if refusal is not None and self._still_counts(refusal, fresh=fresh):
            raise QueryError(refusal.text, code="refused")
        return await self._shared(("parameters", sections), lambda: self._ask_parameters(sections))

    async def fill(self) -> None:
        """Ask for each section, so that the cache has what the server says to each question.

        Not of a server that did not say its parameters at the start of the connection.
        """
        everything = self._known.get(())
        if everything is None or everything.session != self.session:
            return
        for section in SECTIONS:
            try:
                await self.parameters((section,), fresh=False, stale_ok=False)
            except QueryError as error:
                logger.debug("%s: section %s not known: %s", self.source.name, section, error)
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

    def _first_ask(self) -> Ask | None:
        return next((ask for stream in self._streams if (ask := stream.ask()) is not None), None)

    def _still_counts(self, said: Known | _Refusal, *, fresh: bool) -> bool:
        """Return whether this connection's server said it, and, for ``fresh``, just now."""
        if said.session != self.session:
            return False
        return not fresh or time.monotonic() - said.came_s < self.source.fresh_interval_s

    async def _ask_parameters(self, sections: Sections) -> Known:
        """Ask the server; where it knows no sections, or sends all whatever is asked, take all."""
        session = self.session
        takes_sections = bool(sections) and self._whole_only != session
        commands = [SendParameters(sections), SendParameters()] if takes_sections else [SendParameters()]
        try:
            command, packet = await self._ask_server(self._first_ask, commands)
        except QueryError as error:
            if error.code == "refused":
                self._refusals[sections] = _Refusal(str(error), session, time.monotonic())
            raise
        if takes_sections and command != commands[0]:
            self._whole_only = session
        if len(packet.body) > LONG_XML_BYTES:
            known = await asyncio.to_thread(known_from, sections, packet.body, session)
        else:
            known = known_from(sections, packet.body, session)
        before, self._known[sections] = self._known.get(sections), known
        if before is None or before.session != session or known.content != before.content:
            self._note_change(known, before)
        return known

    def _note_change(self, known: Known, before: Known | None) -> None:
        """Tell of parameters that are new; where a section is, all are asked for first."""
        if known.sections:
            if before is not None and before.session == known.session:
                self._task(("parameters", ()), lambda: self._ask_parameters(()))
        elif known.parsed is not None:
            self._known = {(): known}  # the sections are to be asked for anew
            self._changed(known.xml, known.parsed)

    async def _parameters(self, question: Question) -> Answer:
        sections = (question.name,) if question.name else ()
        known = await self.parameters(sections, fresh=question.fresh, stale_ok=question.stale_ok)
        attachment: dict[str, Any] = {"age_s": round(known.age_s, 3), "session": known.session}
        if self._first_ask() is None:
            attachment["stale"] = True
        if not question.as_json:
            return Answer(known.xml, XML, attachment)
        if known.parsed is None:
            raise QueryError(
                "the server's XML cannot be read; ask without format=json to see it as it came",
                code="unreadable",
            )
        if known.json is None:
            raise QueryError(f"the server's answer has no section {question.name}", code="nothing-yet")
        return Answer(known.json, JSON, attachment | {"recovered": list(known.parsed.recovered)})

    async def _component(self, question: Question) -> Answer:
        kind = COMPONENTS_BY_KEY[question.name]
        stream = next(stream for stream in self._streams if kind in stream.components)
        session = stream.status.session
        if stream.ask() is None:
            raise QueryError(self.connection_problem(), code="no-connection")
        if stream.status.state is StreamState.STREAMING:
            message = self._newest().get(kind)
            if message is None or _session_of(message) != session:
                raise QueryError(
                    f"no {question.name} has come from source {self.source.name!r} in this session",
                    code="nothing-yet",
                )
        else:
            component = await self._shared(("frame", kind), lambda: self._current(kind, stream))
            utime = now_utime()
            message = splice(component, Stamp(utime, utime, session), NOT_PUBLISHED)
        return message_answer(message, question, {"session": session})

    async def _current(self, kind: ComponentType, stream: StreamAccess) -> Component:
        """Ask for the current frame (§5.3.4), without a name if the server knows none (field note 2)."""
        _, packet = await self._ask_server(stream.ask, [SendCurrentFrame((kind,)), SendCurrentFrame()])
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
        self, find_ask: Callable[[], Ask | None], commands: Sequence[Command]
    ) -> tuple[Command, Packet]:
        """Return the first of the commands that the server answers, and its answer.

        Raises QueryError, at the latest after query_timeout_s, the wait for other questions included.
        """
        name = f"source {self.source.name!r}"
        problem = QueryError(f"{name}: nothing to ask")
        try:
            async with asyncio.timeout(self.source.query_timeout_s), self._server_is_asked:
                for command in commands:
                    ask = find_ask()
                    if ask is None:
                        raise QueryError(self.connection_problem(), code="no-connection")
                    try:
                        return command, await ask(command)
                    except ServerError as error:
                        text = f"the server does not know {command}, or refuses it: {error}"
                        problem = QueryError(f"{name}: {text}", code="refused")
                    except ReplyTimeoutError as error:
                        problem = QueryError(f"{name}: {error}", code="timeout")
        except LinkError as error:
            raise QueryError(f"{name} has just lost its connection: {error}", code="no-connection") from error
        except TimeoutError:
            waited = f"no answer within {self.source.query_timeout_s:g} s"
            text = f"{name}: {waited}; questions that wait for the server: {len(self._under_way)}"
            raise QueryError(text, code="timeout") from None
        raise problem

    async def _shared(self, key: Hashable, work: Callable[[], Coroutine[Any, Any, _Result]]) -> _Result:
        """Return the result of ``work``, shared by all who want the same at the same time."""
        return await asyncio.shield(self._task(key, work))

    def _task(self, key: Hashable, work: Callable[[], Coroutine[Any, Any, _Result]]) -> asyncio.Task[_Result]:
        task = self._under_way.get(key)
        if task is None:
            task = asyncio.create_task(work())
            task.add_done_callback(lambda done: self._over(key, done))
            self._under_way[key] = task
        return task

    def _over(self, key: Hashable, task: asyncio.Task[Any]) -> None:
        del self._under_way[key]
        if not task.cancelled():
            task.exception()  # retrieved, also where every asker has gone


def _session_of(message: bytes) -> int:
    session: int = PREFIX.unpack_from(message, FINGERPRINT_BYTES)[3]
    return session
