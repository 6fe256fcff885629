"""Answers to queries of peers about the sources of a replay: what a gateway would have answered."""

import time
from collections.abc import Mapping, Sequence
from typing import Any, Final

from gateway.errors import ParametersError, QueryError
from gateway.messages.decode import JSON, XML, prefix_of
from gateway.outputs.contract import Answer, KeyPath, ServerParameters
from gateway.queries.answers import NewestJson, message_answer, schema_answer
from gateway.queries.questions import (
    RECORDING,
    Question,
    accepted_keys,
    check_sections,
    known_keys,
    parse_question,
    parse_questions,
)
from gateway.queries.server_answer import ServerAnswer, unreadable
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.stream.replies import XmlThread
from gateway.takes.replay.publication import ReplayedSource

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
