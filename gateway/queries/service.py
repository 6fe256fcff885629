"""The query service: it finds the source, or the output's own command, that answers a peer's query.

The server gets one request at a time, and equal questions at the same time share its answer.
"""

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from functools import partial
from typing import Any, Final, Protocol

from gateway.config.settings import SourceSettings
from gateway.errors import FrameError, QueryError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.decode import JSON, LCM_MESSAGES, XML, json_bytes, message_type, prefix_of
from gateway.messages.descriptions.source_frame import source_frame
from gateway.messages.encode import NOT_PUBLISHED, Stamp, encode_message
from gateway.messages.history import FoundMessages, MessageHistory, WantedMessages, pack_messages
from gateway.messages.host_time import now_utime
from gateway.outputs.contract import CONTROL_OPTION, STOP, Answer, Command, KeyPath, ServerParameters
from gateway.outputs.registry import OUTPUTS
from gateway.queries.answers import JsonPayload, NewestJson, QueryHistory, message_answer, schema_answer
from gateway.queries.parameter_cache import Announce, ParameterCache
from gateway.queries.questions import (
    RECORDING,
    Question,
    accepted_keys,
    check_sections,
    known_keys,
    parse_question,
    parse_questions,
)
from gateway.queries.server_requests import RecordingAccess, Recordings, ServerRequests, StreamAccess
from gateway.rtc3d.commands import SendCurrentFrame
from gateway.rtc3d.components import COMPONENTS_BY_KEY, Component, ComponentType
from gateway.rtc3d.frames import detect_byte_order, split_frame
from gateway.rtc3d.packets import PacketType
from gateway.rtc3d.parameters import SECTIONS, Parameters
from gateway.runtime.safe_text import quoted
from gateway.runtime.token_bucket import TokenBucket
from gateway.session.state import StreamState

CONTROLS_PER_S: Final = 4.0
"""How many commands a second that start, stop or change something are carried out."""


_FINDS_PER_S: Final = 200.0
"""How many times a second messages are found in the history of a source: each takes 0.1 to 1 ms."""


class PublishedMessages(Protocol):
    """What was published of a source. Messages have the numbers that the output of a name has given them."""

    history: MessageHistory

    def newest(self, component: ComponentType, output: str) -> bytes | None:
        """Return the newest message of a component; None before the first."""

    async def find(self, key: str, output: str, wanted: WantedMessages) -> FoundMessages | None:
        """Return messages of a key from the history; None if it has none of this key. Raises QueryError."""

    @property
    def history_overview(self) -> dict[str, Any]:
        """What the history has of each key."""


class SourceQueries:
    """Answers questions about one source; ``parameters`` has those of its server.

    ``last_c3d`` raises QueryError if there is no file. ``announce_parameters`` takes the server's parameters
    when they change.
    """

    def __init__(
        self,
        settings: SourceSettings,
        streams: Callable[[], Sequence[StreamAccess]],
        published: PublishedMessages,
        status_message: Callable[[], bytes],
        last_c3d: Callable[[], Coroutine[Any, Any, Answer]],
        recording: RecordingAccess,
        announce_parameters: Announce,
        history: QueryHistory,
    ) -> None:
        self.settings = settings
        """A reload can replace them by others that differ only in the frame of poses."""
        self._streams = streams
        self._published = published
        self._status_message = status_message
        self._last_c3d = last_c3d
        self._requests = ServerRequests(settings, streams)
        self._history = history
        self._recordings = Recordings(settings.name, self._requests, recording, history)
        self._newest_json = NewestJson()
        self._controls = TokenBucket(CONTROLS_PER_S)
        self._finds = TokenBucket(_FINDS_PER_S)
        self.num_found: Counter[str] = Counter()
        """How many messages of the history peers have got, by output."""
        self.parameters: ParameterCache = ParameterCache(
            settings, self._requests, announce_parameters, history
        )

    @property
    def server(self) -> str:
        """HOST:PORT of the server."""
        return f"{self.settings.host}:{self.settings.port}"

    @property
    def components(self) -> frozenset[ComponentType]:
        """The components of all streams."""
        return frozenset(component for stream in self._streams() for component in stream.components)

    @property
    def session(self) -> int:
        """A number that grows with every connection of any stream."""
        return self._requests.session

    @property
    def frame(self) -> CoordinateFrame:
        """The coordinate frame of the source's poses."""
        newest = self.parameters.newest
        return source_frame(self.settings, Parameters() if newest is None else newest.parsed.parameters)

    def check_control(self, action: str) -> None:
        """Raise QueryError unless peers may now start, stop or change something of this source.

        No rate refuses what stops something, which would go on; Recordings has a limit of its own. A
        recording that a peer has started may be stopped even if a reload has switched the control off.
        """
        name, is_stop = self.settings.name, action == STOP
        if not (self.settings.remote_control or (is_stop and self._history.is_recording)):
            raise QueryError(
                f"remote control is off for source {name!r}; to switch it on, set remote_control: true "
                "for it in the gateway's configuration",
                code="refused",
            )
        if not is_stop and not self._controls.try_take():
            raise QueryError(
                f"source {name!r} takes {CONTROLS_PER_S:g} commands a second that start or stop something; "
                "try again",
                code="rate",
            )

    async def answer(self, question: Question, output: str = "") -> Answer:
        """Return the answer to a query on the output of this name; "" stands for any output.

        Raises QueryError, at the latest after query_timeout_s.
        """
        match question.kind:
            case "parameters":
                return await self._parameters(question)
            case "component":
                return await self._component(question, output)
            case "messages" | "history" | "status":
                return await self._without_server(question, output)
            case "schema":
                return schema_answer(question.name)
            case "c3d":
                return await self._requests.share("c3d", self._last_c3d)
            case "recording":
                return await self._recording(question)

    async def _parameters(self, question: Question) -> Answer:
        sections = (question.name,) if question.name else ()
        cached = await self.parameters.get(sections, fresh=question.fresh, stale_ok=question.stale_ok)
        attachment: dict[str, Any] = {
            "age_s": round(cached.age_s, 3),
            "session": cached.session,
            "parameters_version": cached.version,
            "frame": self.frame.facts,
        }
        if not self._requests.is_connected:
            attachment["stale"] = True
        if not question.as_json:
            return Answer(cached.xml, XML, attachment)
        if not cached.is_readable:
            raise QueryError(
                "the server's XML cannot be read; ask without format=json to see it as received",
                code="unreadable",
            )
        payload = cached.json
        if payload is None:
            raise QueryError(f"the server's answer has no section {question.name}", code="nothing-yet")
        return Answer(payload, JSON, attachment | {"recovered": list(cached.parsed.recovered)})

    async def _component(self, question: Question, output: str) -> Answer:
        """Return the newest message of the stream; while it does not run, ask for the current frame."""
        component = COMPONENTS_BY_KEY[question.name]
        stream = next((stream for stream in self._streams() if component in stream.components), None)
        if stream is None:  # since the question was checked
            raise QueryError(f"no stream of source {self.settings.name!r} has {component.key} any more")
        session = stream.status.session
        if stream.connection is None:
            raise self._requests.no_connection_error()
        if stream.status.state is StreamState.STREAMING:
            message = self._published.newest(component, output)
            if message is None or prefix_of(message).session != session:
                raise QueryError(
                    f"no {component.key} has arrived from source {self.settings.name!r} in this session",
                    code="nothing-yet",
                )
        else:
            current = await self._requests.share(
                ("frame", component), lambda: self._current_frame(component, stream)
            )
            utime = now_utime()
            message = encode_message(
                current, Stamp(utime, utime, session, self._requests.parameters_version), NOT_PUBLISHED
            )
        return self._message_answer(message, question, output)

    async def _without_server(self, question: Question, output: str) -> Answer:
        """Return the status, or what the history has: all keys, or messages of MAX_ANSWER_BYTES at most."""
        if question.kind == "history":
            overview = {**self._published.history_overview, "num_found": self.num_found}
            return Answer(json_bytes(overview), JSON)
        if question.wanted is None:
            return self._message_answer(self._status_message(), question, output)
        if not self._finds.try_take():
            raise QueryError(
                f"the gateway finds messages of a source {_FINDS_PER_S:g} times a second; ask again",
                code="rate",
            )
        found = await self._published.find(question.name, output, question.wanted)
        if found is None and not self._published.history.is_kept:
            raise QueryError(
                "the gateway keeps no messages; to keep some, set history.seconds in its configuration",
                code="disabled",
            )
        if found is None:
            name = self.settings.name
            text = f"the history of source {name!r} has no messages of {quoted(question.name)}"
            raise QueryError(text, code="nothing-yet")
        messages = found.messages
        self.num_found[output] += len(messages)
        schema = f";rtc3d.{message_type(messages[0]).__name__}" if messages else ""
        return Answer(pack_messages(messages), f"{LCM_MESSAGES}{schema}", found.facts)

    def _message_answer(self, message: bytes, question: Question, output: str) -> Answer:
        payload: JsonPayload | None = None
        if question.as_json:
            key = question.name or question.kind
            message, payload = self._newest_json.of(f"{key} {output}", message)
        attachment = {}
        if question.kind == "component":
            prefix = prefix_of(message)
            attachment = {"session": prefix.session, "parameters_version": prefix.parameters_version}
        return message_answer(message, attachment) if payload is None else Answer(payload, JSON, attachment)

    async def _current_frame(self, component: ComponentType, stream: StreamAccess) -> Component:
        """Request a component of the current frame (§5.3.4).

        If the server does not accept the component's name, request the whole frame (field note 2).
        """
        packet = await self._requests.send(
            SendCurrentFrame((component,)), fallback=SendCurrentFrame(), connection=stream.connection
        )
        if packet.type == PacketType.NO_DATA:
            raise QueryError(f"source {self.settings.name!r}: no measurement runs", code="nothing-yet")
        try:
            frame = split_frame(packet.body, detect_byte_order(packet.body, self.settings.byte_order))
        except FrameError as error:
            raise QueryError(f"the current frame cannot be read: {error}", code="unreadable") from error
        found = next((each for each in frame.components if each.type is component), None)
        if found is None:
            raise QueryError(f"the current frame has no {component.key}", code="nothing-yet")
        return found

    async def _recording(self, question: Question) -> Answer:
        if not question.set:
            raise QueryError("recording needs an option; accepted: set=start;name=NAME, set=stop")
        if question.set == "start":
            content, reply = await self._recordings.start(question.name, question.options)
        else:
            content, reply = await self._recordings.stop()
        return Answer(json_bytes(content), JSON, {"reply": reply} if reply else {})


class SourceQueryService:
    """Implements QueryService (outputs/contract.py) for the sources of one gateway.

    ``sources`` returns the queries of each source, ``commands`` the outputs' own commands, both by name.
    ``output`` is the name of the output whose queries it answers.
    """

    def __init__(
        self,
        sources: Callable[[], Mapping[str, SourceQueries]],
        commands: Callable[[], Mapping[str, Command]],
        output: str,
    ) -> None:
        self._sources = sources
        self._commands = commands
        self._output = output

    def serves(self, source: str) -> bool:
        """See QueryService."""
        return source in self._sources()

    def server(self, source: str) -> str:
        """See QueryService."""
        queries = self._sources().get(source)
        return "" if queries is None else queries.server

    def keys(self, source: str) -> list[KeyPath]:
        """See QueryService. Commands are left out, so that no wildcard starts anything by accident."""
        return [path for path in known_keys(self._sources()[source].components) if path != RECORDING]

    def commands(self) -> list[str]:
        """See QueryService. Those of outputs that are off are included: their answer says so."""
        of_kinds = (command for kind in OUTPUTS.values() for command in kind.commands)
        return [*dict.fromkeys(("/".join(RECORDING), *self._commands(), *of_kinds))]

    def accepted_keys(self, source: str) -> str:
        """See QueryService."""
        return accepted_keys(self._sources()[source].components, self._commands())

    async def answer(self, source: str, path: KeyPath, options: Mapping[str, str]) -> Answer:
        """See QueryService."""
        queries = self._sources()[source]
        name = "/".join(path)
        answer: Callable[[], Awaitable[Answer]]
        if (command := self._commands().get(name)) is not None:
            answer = partial(command, source, options)
        elif off := [kind.name for kind in OUTPUTS.values() if name in kind.commands]:
            raise QueryError(
                f"the output {off[0]} is off; to use {name}, set {off[0]}.enabled: true in the gateway's "
                "configuration",
                code="disabled",
            )
        else:
            answer = partial(queries.answer, parse_question(path, options, queries.components), self._output)
        if CONTROL_OPTION in options:
            queries.check_control(options[CONTROL_OPTION])
        return await answer()

    async def answer_all(
        self, source: str, paths: Sequence[KeyPath], options: Mapping[str, str]
    ) -> dict[KeyPath, Answer]:
        """See QueryService. Exceptions other than QueryError are raised in any case."""
        queries = self._sources()[source]
        questions = parse_questions(paths, options, queries.components)
        results = await asyncio.gather(
            *(queries.answer(question, self._output) for question in questions.values()),
            return_exceptions=True,
        )
        errors = [result for result in results if isinstance(result, BaseException)]
        for error in errors:
            if not isinstance(error, QueryError):
                raise error
        answers = {
            path: result
            for path, result in zip(questions, results, strict=True)
            if not isinstance(result, BaseException)
        }
        if errors and not answers:
            raise errors[0]
        return answers

    async def parameters(self, source: str, sections: Sequence[str], *, fresh: bool) -> ServerParameters:
        """See QueryService."""
        check_sections(sections)
        ordered = tuple(section for section in SECTIONS if section in sections)
        cached = await self._sources()[source].parameters.get(
            () if ordered == tuple(SECTIONS) else ordered, fresh=fresh, stale_ok=False
        )
        return ServerParameters(cached.xml, cached.session, cached.version, cached.age_s)
