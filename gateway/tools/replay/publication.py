"""Publishing the messages of a take, and answering queries, as the gateway that recorded them did."""

import asyncio
import re
import time
from collections import Counter
from collections.abc import Callable, Coroutine, Mapping, Sequence
from concurrent.futures import wait
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from gateway.errors import OutputError, ParametersError, ProtocolError, QueryError
from gateway.messages.decode import JSON, XML, decode, message_type, prefix_of
from gateway.messages.encode import CONTENT_OFFSET, lcm_type_name
from gateway.messages.texts import xml_bytes
from gateway.messages.topics import MAX_SOURCES, Topic, lcm_channel, unique_name
from gateway.outputs.contract import Answer, KeyPath, Output, ServerParameters
from gateway.queries.answers import NewestJson, ServerAnswer, message_answer, schema_answer, unreadable
from gateway.queries.questions import (
    RECORDING,
    Question,
    accepted_keys,
    check_sections,
    known_keys,
    parse_question,
    parse_questions,
)
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.session.replies import XmlThread
from gateway.takes.files.parameters_history import recorded_parameters

_PARAMETERS_S: Final = 1.0
"""How long messages wait at most until the outputs have sent the parameters that describe them."""

_DECLARED_S: Final = 1.0
"""How long the first message of a key waits at most until the outputs can send it."""

MAX_TOPICS: Final = 4096
"""Further keys are left out: a gateway has at most 261 per source."""

MAX_NAME_LENGTH: Final = 24
_NOT_IN_NAMES: Final = re.compile("[^A-Za-z0-9_-]+")
"""Names of sources are like those in a configuration; a log of other programs may have any."""


class PublicationRefusal(NamedTuple):
    """What an output did not accept: the key of the messages, the output, and its cause."""

    key: str
    output: str
    cause: str


@dataclass
class ReplayedSource:
    """What was published of one source: its newest parameters, and when; the newest message by key."""

    name: str
    parameters: ServerParameters | None = None
    published_s: float = 0.0
    newest: dict[str, bytes] = field(default_factory=dict)


class _Route(NamedTuple):
    """Where the messages of one key go: the newest is kept, and each output has a publisher."""

    newest: dict[str, bytes]
    component: str
    publishers: Sequence[tuple[str, Callable[[bytes], None]]]


class Publication:
    """Publishes the messages of a take in one thread; what outputs do not allow there is done in ``loop``.

    ``sources`` gets the sources, by name.
    """

    def __init__(
        self,
        outputs: Sequence[Output],
        sources: dict[str, ReplayedSource],
        loop: asyncio.AbstractEventLoop,
    ) -> None:
        self.sources = sources
        self.num_messages: Counter[str] = Counter()
        """How many messages were published, by key without the labels of tools."""
        self.refusals: Counter[PublicationRefusal] = Counter()
        """What the outputs did not accept."""
        self.num_unreadable: Counter[str] = Counter()
        """How many messages without a whole prefix, and parameters, could not be read, by source."""
        self.num_surplus = 0
        """How many messages had too many different keys or sources to be published."""
        self.without_parameters: set[str] = set()
        """The sources of which a component came before any parameters."""
        self._outputs = outputs
        self._loop = loop
        self._routes: dict[tuple[str, str], _Route] = {}  # by the recorded source and the key
        self._recorded_sources: dict[str, ReplayedSource] = {}

    # In the thread that publishes.

    def publish(self, source: str, key: str, message: bytes) -> None:
        """Publish one message. What an output refuses is counted."""
        if key == "parameters":
            self._publish_parameters(source, message)
            return
        if len(message) < CONTENT_OFFSET:
            self.num_unreadable[source] += 1
            return
        route = self._routes.get((source, key)) or self._open(source, key, message)
        if route is None:
            self.num_surplus += 1
            return
        route.newest[key] = message
        for output, publish in route.publishers:
            try:
                publish(message)
            except OutputError as error:
                self.refusals[PublicationRefusal(route.component, output, error.cause)] += 1
        self.num_messages[route.component] += 1

    def _open(self, recorded_source: str, key: str, message: bytes) -> _Route | None:
        source = self._source(recorded_source)
        if source is None or len(self._routes) >= MAX_TOPICS:
            return None
        if source.parameters is None and key not in {"status", "clock"}:
            self.without_parameters.add(source.name)
        name, _, label = key.partition("/")
        path = (name, _recorded_label(label, source.parameters)) if label else (name,)
        topic = Topic(source.name, path, lcm_type_name(message_type(message)))
        publishers = [(output.name, output.publisher(topic).publish) for output in self._outputs]
        declared = [future for output in self._outputs if (future := output.until_declared()) is not None]
        wait(declared, timeout=_DECLARED_S)  # or the first message would be refused
        route = _Route(source.newest, f"{name}/tool" if label else name, publishers)
        self._routes[recorded_source, key] = route
        return route

    def _source(self, recorded_name: str) -> ReplayedSource | None:
        """Return a source, which gets a name that is possible in a key; None if there are too many."""
        source = self._recorded_sources.get(recorded_name)
        if source is None and len(self.sources) < MAX_SOURCES:
            name = unique_name(_NOT_IN_NAMES.sub("-", recorded_name) or "-", self.sources, MAX_NAME_LENGTH)
            source = self.sources[name] = self._recorded_sources[recorded_name] = ReplayedSource(name)
            self._in_loop(self._announce(name))
        return source

    def _publish_parameters(self, recorded_source: str, message: bytes) -> None:
        try:
            recorded = decode(message)
        except ProtocolError:
            self.num_unreadable[recorded_source] += 1
            return
        source = self._source(recorded_source)
        if source is None:
            self.num_surplus += 1
            return
        before, xml = source.parameters, xml_bytes(recorded.xml)
        if before is not None and before.xml == xml:
            parsed = before.parsed
        else:
            parsed = recorded_parameters(xml) or Parameters()
        parameters = ServerParameters(
            xml,
            recorded.session,
            recorded.parameters_version,
            message=message,
            parsed=parsed,
        )
        source.parameters, source.published_s = parameters, time.monotonic()
        is_new = before is None or before[:3] != parameters[:3]
        self._in_loop(self._send_parameters(source.name, parameters, wait=is_new))
        self.num_messages["parameters"] += 1

    def _in_loop(self, work: Coroutine[Any, Any, None]) -> None:
        asyncio.run_coroutine_threadsafe(work, self._loop).result()

    # In the event loop.

    async def _announce(self, source: str) -> None:
        for output in self._outputs:
            output.announce(source)
            output.show_streaming(source, True)

    async def _send_parameters(self, source: str, parameters: ServerParameters, *, wait: bool) -> None:
        """Publish parameters; if ``wait``, wait until no message can overtake them, as the gateway does."""
        sent = [output.publish_parameters(source, parameters) for output in self._outputs]
        pending = [future for future in sent if future is not None]
        if wait and pending:
            await asyncio.wait(pending, timeout=_PARAMETERS_S)

    def show_streaming(self, is_streaming: bool) -> None:
        """Show peers whether messages come, or the replay pauses."""
        for output in self._outputs:
            for source in list(self.sources):
                output.show_streaming(source, is_streaming)


def _recorded_label(label: str, parameters: ServerParameters | None) -> str:
    """Return the label of a tool from the parameters; ``label`` is what the channel has of it."""
    tools = None if parameters is None else parameters.parsed.tools
    for tool in () if tools is None else tools.tools:
        if lcm_channel("", tool.label) == lcm_channel("", label):
            return tool.label.strip()
    return label


_NOT_IN_A_REPLAY: Final = ("c3d", "recording")


class ReplayQueries:
    """Implements QueryService (outputs/contract.py) for the sources of a replay.

    ``sources`` are those that have been replayed so far, by name.
    """

    def __init__(self, sources: Mapping[str, ReplayedSource]) -> None:
        self._sources = sources
        self._xml_thread = XmlThread("replay")
        self._answers: dict[str, tuple[ServerParameters, ServerAnswer]] = {}  # by source
        self._newest_json = NewestJson()

    def serves(self, source: str) -> bool:
        """See QueryService."""
        return source in self._sources

    def server(self, source: str) -> str:  # noqa: ARG002 - the contract's argument
        """See QueryService."""
        return ""

    def keys(self, source: str) -> list[KeyPath]:
        """See QueryService."""
        return [path for path in known_keys(self._components(source)) if path[0] not in _NOT_IN_A_REPLAY]

    def commands(self) -> list[str]:
        """See QueryService."""
        return ["/".join(RECORDING)]

    def accepted_keys(self, source: str) -> str:
        """See QueryService."""
        return accepted_keys(self._components(source))

    async def answer(self, source: str, path: KeyPath, options: Mapping[str, str]) -> Answer:
        """See QueryService."""
        return await self._answer(source, parse_question(path, options, self._components(source)))

    async def answer_all(
        self, source: str, paths: Sequence[KeyPath], options: Mapping[str, str]
    ) -> dict[KeyPath, Answer]:
        """See QueryService."""
        answers: dict[KeyPath, Answer] = {}
        first_error: QueryError | None = None
        for path, question in parse_questions(paths, options, self._components(source)).items():
            try:
                answers[path] = await self._answer(source, question)
            except QueryError as error:
                first_error = first_error or error
        if first_error is not None and not answers:
            raise first_error
        return answers

    async def parameters(self, source: str, sections: Sequence[str], *, fresh: bool) -> ServerParameters:  # noqa: ARG002 - there is nothing fresher
        """See QueryService."""
        check_sections(sections)
        known, answer = await self._known(source, tuple(sections))
        return ServerParameters(answer.xml, known.session, known.version, self._age_s(source))

    def _components(self, source: str) -> frozenset[ComponentType]:
        return frozenset(
            COMPONENTS_BY_KEY[key] for key in list(self._sources[source].newest) if key in COMPONENTS_BY_KEY
        )

    def _age_s(self, source: str) -> float:
        return time.monotonic() - self._sources[source].published_s

    async def _answer(self, source: str, question: Question) -> Answer:
        match question.kind:
            case "parameters":
                return await self._parameters_answer(source, question)
            case "component" | "status":
                return self._message_answer(source, question)
            case "schema":
                return schema_answer(question.name)
            case _:
                raise QueryError(f"{source!r} is a replay, which has no {question.kind}", code="refused")

    async def _parameters_answer(self, source: str, question: Question) -> Answer:
        known, answer = await self._known(source, (question.name,) if question.name else ())
        attachment: dict[str, Any] = {
            "age_s": round(self._age_s(source), 3),
            "session": known.session,
            "parameters_version": known.version,
        }
        if not question.as_json:
            return Answer(answer.xml, XML, attachment)
        payload = answer.json
        if payload is None:
            raise QueryError(
                "the recorded XML cannot be read, or has no such section; ask without format=json to see it",
                code="unreadable",
            )
        return Answer(payload, JSON, attachment | {"recovered": list(answer.parsed.recovered)})

    async def _known(self, source: str, sections: tuple[str, ...]) -> tuple[ServerParameters, ServerAnswer]:
        """Return the parameters that were published last, and their part for some sections."""
        known = self._sources[source].parameters
        if known is None or not known.xml:
            raise QueryError(f"no parameters of source {source!r} have been replayed", code="nothing-yet")
        before = self._answers.get(source)
        if before is None or before[0] is not known:
            try:
                parsed = await self._xml_thread.process(known.xml, parse_parameters)
                answer = ServerAnswer((), known.xml, parsed, known.session, known.version)
            except ParametersError as error:
                answer = unreadable((), known.xml, known.session, known.version, error)
            before = self._answers[source] = known, answer
        answer = before[1]
        if sections:
            part = await answer.part(sections, self._xml_thread)
            if part is None:
                raise QueryError(
                    f"the recorded parameters have no section {', '.join(sections)}", code="nothing-yet"
                )
            answer = part
        return known, answer

    def _message_answer(self, source: str, question: Question) -> Answer:
        key = question.name or question.kind
        message = self._sources[source].newest.get(key)
        if message is None:
            raise QueryError(f"no {key} of source {source!r} has been replayed", code="nothing-yet")
        prefix = prefix_of(message)
        attachment = {"session": prefix.session, "parameters_version": prefix.parameters_version}
        if question.as_json:
            _, payload = self._newest_json.of(f"{source}/{key}", message)
            return Answer(payload, JSON, attachment)
        return message_answer(message, attachment)
