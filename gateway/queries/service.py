"""The query service: it finds the source, or the output's own command, that answers a peer's query."""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from gateway.errors import QueryError
from gateway.outputs.contract import CONTROL_OPTION, Answer, Command, KeyPath, ServerParameters
from gateway.outputs.registry import OUTPUTS
from gateway.queries.questions import (
    RECORDING,
    accepted_keys,
    check_sections,
    known_keys,
    parse_question,
    parse_questions,
)
from gateway.queries.source_queries import SourceQueries
from gateway.rtc3d.parameters import SECTIONS


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
        command = self._commands().get(name)
        if command is None:
            _check_no_output_is_off(name)
        answer = (
            partial(queries.answer, parse_question(path, options, queries.components), self._output)
            if command is None
            else partial(command, source, options)
        )
        if CONTROL_OPTION in options:
            queries.check_control()
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
        answers: dict[KeyPath, Answer] = {}
        errors: list[QueryError] = []
        for path, result in zip(questions, results, strict=True):
            match result:
                case Answer():
                    answers[path] = result
                case QueryError():
                    errors.append(result)
                case _:
                    raise result
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


def _check_no_output_is_off(command: str) -> None:
    """Raise QueryError if this is the command of an output that is not enabled."""
    for kind in OUTPUTS.values():
        if command in kind.commands:
            raise QueryError(
                f"the output {kind.name} is off; to use {command}, set {kind.name}.enabled: true in the "
                "gateway's configuration",
                code="disabled",
            )
