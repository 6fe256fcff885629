"""Answers questions about one source, asking its server as little as can be.

One question to the server is under way at a time; peers that ask the same meanwhile share its answer,
and for ``fresh_interval_s`` after it nobody's ``fresh`` reaches the server again.
"""

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Final, NamedTuple

from gateway.config import Source
from gateway.errors import (
    ClosedError,
    FrameError,
    LinkError,
    ParametersError,
    QueryError,
    ReplyTimeoutError,
    ServerError,
)
from gateway.message import Stamp, splice
from gateway.queries.answers import (
    JSON,
    XML,
    Answer,
    Question,
    json_bytes,
    message_answer,
    parameters_json,
    schema_answer,
)
from gateway.rtc3d.commands import SECTIONS, Command, SendCurrentFrame, SendParameters
from gateway.rtc3d.components import BY_KEY, Component, ComponentType, byte_order_of, split_frame
from gateway.rtc3d.packets import Packet, PacketType
from gateway.rtc3d.parameters_xml import ParsedParameters, parse_parameters
from gateway.status import StreamStatus, now_utime
from gateway.stream_state import StreamState

NOT_PUBLISHED: Final = -1
"""The sequence number of a frame that was asked for and is no part of the stream."""

Sections = tuple[str, ...]
"""Parameter sections of a question, as in SECTIONS; () for all."""

Ask = Callable[[Command], Awaitable[Packet]]
"""Sends a command over a connection; raises ServerError, ReplyTimeoutError or LinkError."""


logger = logging.getLogger(__name__)


class StreamAccess(NamedTuple):
    """One stream as the desk sees it: ``ask`` gives None while there is no connection."""

    components: Sequence[ComponentType]
    status: StreamStatus
    ask: Callable[[], Ask | None]


class Known(NamedTuple):
    """An answer of the server to SendParameters; ``parsed`` is None if nothing could be read from it."""

    xml: bytes
    parsed: ParsedParameters | None
    came_s: float  # monotonic
    session: int


class Desk:
    """Answers questions about one source.

    ``newest`` holds the newest message of each component in this session. ``last_c3d`` raises QueryError
    if there is none. ``record`` starts (True) or stops a recording, and gives False if no connection is
    there to do it.
    """

    def __init__(
        self,
        source: Source,
        streams: Sequence[StreamAccess],
        newest: Mapping[ComponentType, bytes],
        status_message: Callable[[], bytes],
        last_c3d: Callable[[], Awaitable[Answer]],
        record: Callable[[bool], bool],
    ) -> None:
        self.source = source
        self.components = frozenset(kind for stream in streams for kind in stream.components)
        self._streams = streams
        self._newest = newest
        self._status_message = status_message
        self._last_c3d = last_c3d
        self._record = record
        self._known: dict[Sections, Known] = {}
        self._refusals: dict[Sections, tuple[QueryError, int]] = {}
        self._under_way: dict[Command, asyncio.Task[Packet]] = {}
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
                return await self._last_c3d()
            case "recording":
                return self._recording(question)

    def learn(self, xml: bytes, parsed: ParsedParameters) -> None:
        """Take the parameters that a connection began with."""
        self._known[()] = Known(xml, parsed, time.monotonic(), self.session)

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
        if known is not None and known.session == self.session:
            if not fresh or time.monotonic() - known.came_s < self.source.fresh_interval_s:
                return known
        elif not fresh:
            self._raise_refusal(sections)
        try:
            packet = await self._question(SendParameters(sections), self._first_ask)
        except QueryError as error:
            self._refusals[sections] = (error, self.session)
            raise
        self._known[sections] = Known(packet.body, _parsed(packet.body), time.monotonic(), self.session)
        return self._known[sections]

    async def fill(self) -> None:
        """Ask for each section once, so that the cache has what the server says to each question."""
        for section in SECTIONS:
            try:
                await self.parameters((section,), fresh=False, stale_ok=False)
            except QueryError as error:
                logger.debug("%s: section %s not known: %s", self.source.name, section, error)

    def connection_problem(self) -> str:
        """Return why there is no connection, and when that was found."""
        newest = max((stream.status for stream in self._streams), key=lambda status: status.last_error_utime)
        where = f"source {self.source.name!r} has no connection"
        if not newest.last_error:
            return f"{where} yet: connecting to {self.source.host}:{self.source.port}"
        return (
            f"{where}: {newest.last_error}, tried {(now_utime() - newest.last_error_utime) / 1e6:.1f} s ago"
        )

    @property
    def session(self) -> int:
        """A number that grows with every connection of any stream."""
        return sum(stream.status.session for stream in self._streams)

    def _first_ask(self) -> Ask | None:
        return next((ask for stream in self._streams if (ask := stream.ask()) is not None), None)

    def _raise_refusal(self, sections: Sections) -> None:
        """Repeat what this connection's server said no to, unless asked for it afresh."""
        error, session = self._refusals.get(sections, (None, 0))
        if error is not None and error.code == "refused" and session == self.session:
            raise error

    async def _parameters(self, question: Question) -> Answer:
        sections = (question.name,) if question.name else ()
        known = await self.parameters(sections, fresh=question.fresh, stale_ok=question.stale_ok)
        attachment = {"age_s": round(time.monotonic() - known.came_s, 3), "session": known.session}
        if self._first_ask() is None:
            attachment["stale"] = True
        if not question.as_json:
            return Answer(known.xml, XML, attachment)
        if known.parsed is None:
            raise QueryError("the server's XML cannot be read; ask without format=json to see it as it came")
        value = parameters_json(known.parsed.parameters, question.name)
        if value == b"null":
            raise QueryError(f"the server's answer has no section {question.name}", code="nothing-yet")
        return Answer(value, JSON, attachment | {"recovered": list(known.parsed.recovered)})

    async def _component(self, question: Question) -> Answer:
        kind = BY_KEY[question.name]
        stream = next(stream for stream in self._streams if kind in stream.components)
        session = stream.status.session
        if stream.ask() is None:
            raise QueryError(self.connection_problem(), code="no-connection")
        if stream.status.state is StreamState.STREAMING:
            message = self._newest.get(kind)
            if message is None:
                raise QueryError(
                    f"no {question.name} has come from source {self.source.name!r} in this session",
                    code="nothing-yet",
                )
        else:
            component = await self._current(kind, stream)
            utime = now_utime()
            message = splice(component, Stamp(utime, utime, session), NOT_PUBLISHED)
        return message_answer(message, question, {"session": session})

    async def _current(self, kind: ComponentType, stream: StreamAccess) -> Component:
        """Ask for the current frame (§5.3.4), without a name if the server knows none (field note 2)."""
        try:
            packet = await self._question(SendCurrentFrame((kind,)), stream.ask)
        except QueryError as error:
            if error.code != "refused":
                raise
            packet = await self._question(SendCurrentFrame(), stream.ask)
        if packet.type == PacketType.NO_DATA:
            raise QueryError(f"source {self.source.name!r}: no measurement runs", code="nothing-yet")
        try:
            frame = split_frame(packet.body, byte_order_of(packet.body, self.source.byte_order))
        except FrameError as error:
            raise QueryError(f"the current frame cannot be read: {error}", code="refused") from error
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
        if not self._record(question.set == "start"):
            raise QueryError(self.connection_problem(), code="no-connection")
        return Answer(json_bytes({"source": self.source.name, "sent": question.set}), JSON)

    async def _question(self, command: Command, find_ask: Callable[[], Ask | None]) -> Packet:
        """Return the server's answer, shared by all who ask the same at the same time."""
        task = self._under_way.get(command)
        if task is None:
            task = asyncio.create_task(self._ask_server(command, find_ask))
            task.add_done_callback(lambda done: self._over(command, done))
            self._under_way[command] = task
        try:
            async with asyncio.timeout(self.source.query_timeout_s):
                return await asyncio.shield(task)
        except ServerError as error:
            text = f"source {self.source.name!r}: the server refused {command}: {error}"
            raise QueryError(text, code="refused") from error
        except ReplyTimeoutError as error:
            raise QueryError(f"source {self.source.name!r}: {error}", code="timeout") from error
        except LinkError as error:
            raise QueryError(self.connection_problem(), code="no-connection") from error
        except TimeoutError:
            text = (
                f"no answer within {self.source.query_timeout_s:g} s; {len(self._under_way)} questions wait"
            )
            raise QueryError(f"source {self.source.name!r}: {text}", code="timeout") from None

    async def _ask_server(self, command: Command, find_ask: Callable[[], Ask | None]) -> Packet:
        async with self._server_is_asked:
            ask = find_ask()
            if ask is None:
                raise ClosedError(self.connection_problem())
            return await ask(command)

    def _over(self, command: Command, task: asyncio.Task[Packet]) -> None:
        del self._under_way[command]
        if not task.cancelled():
            task.exception()  # retrieved, also where every asker has gone


def _parsed(xml: bytes) -> ParsedParameters | None:
    try:
        return parse_parameters(xml)
    except ParametersError:
        return None
