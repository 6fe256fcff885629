"""The parameters of one source's server: cached, and requested again where the cache is not enough.

For ``fresh_interval_s`` after an answer, a ``fresh`` query gets that answer and does not reach the server.
"""

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, NamedTuple

from gateway.config.settings import SourceSettings
from gateway.errors import ParametersError, QueryError
from gateway.queries.answers import parameters_json
from gateway.queries.server_requests import ServerRequests
from gateway.rtc3d.commands import SendParameters
from gateway.rtc3d.parameters import SECTIONS, without_statistics
from gateway.rtc3d.parameters_xml import ParsedParameters, parse_parameters

LONG_XML_BYTES: Final = 64 * 1024
"""Longer XML is parsed in a thread: 1 MiB of it, made to be slow, takes 4 s."""

Sections = tuple[str, ...]
"""The parameter sections of a query, as in SECTIONS; () for all."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class CachedParameters:
    """A server's answer to SendParameters. ``parsed`` is None if nothing could be read from it."""

    sections: Sections
    xml: bytes
    parsed: ParsedParameters | None
    session: int
    received_s: float = field(default_factory=time.monotonic)

    @property
    def age_s(self) -> float:
        """How long ago the answer arrived."""
        return time.monotonic() - self.received_s

    @cached_property
    def json(self) -> bytes | None:
        """The parameters as JSON, built once for all queries; None if the answer has none of them."""
        if self.parsed is None:
            return None
        return parameters_json(self.parsed.parameters, self.sections[0] if len(self.sections) == 1 else "")

    @cached_property
    def without_statistics(self) -> object:
        """What is compared to find changes: the parameters without the server's statistics (§6.1)."""
        if self.parsed is None:
            return self.xml
        return without_statistics(self.parsed.parameters)


def parse_answer(sections: Sections, xml: bytes, session: int) -> CachedParameters:
    """Parse the server's answer to SendParameters for ``sections``, and convert it to JSON."""
    try:
        cached = CachedParameters(sections, xml, parse_parameters(xml), session)
    except ParametersError:
        return CachedParameters(sections, xml, None, session)
    _ = cached.json  # convert it here, because this function may run in a thread
    return cached


class _Refusal(NamedTuple):
    """The server's refusal of SendParameters."""

    text: str
    session: int
    received_s: float


class ParameterCache:
    """The answers to SendParameters, by the sections that were requested.

    ``on_change`` is called with all parameters when they differ from the last ones.
    """

    def __init__(
        self,
        settings: SourceSettings,
        requests: ServerRequests,
        on_change: Callable[[bytes, ParsedParameters], None],
    ) -> None:
        self._settings = settings
        self._requests = requests
        self._on_change = on_change
        self._cached: dict[Sections, CachedParameters] = {}
        self._refusals: dict[Sections, _Refusal] = {}
        self._session_without_sections: int | None = None  # whose server does not send single sections

    def store(self, xml: bytes, parsed: ParsedParameters) -> None:
        """Cache all parameters, as the server sent them at the start of a connection."""
        self._cached[()] = CachedParameters((), xml, parsed, self._requests.session)

    @property
    def xml(self) -> bytes | None:
        """All parameters as the server last sent them; None before the first time."""
        cached = self._cached.get(())
        return None if cached is None else cached.xml

    async def get(self, sections: Sections, *, fresh: bool, stale_ok: bool) -> CachedParameters:
        """Return the server's answer for some sections, () for all, from the cache or from the server.

        The answer of an earlier connection is returned only while there is none, and only if ``stale_ok``.
        Raises QueryError.
        """
        cached = self._cached.get(sections)
        if not self._requests.is_connected:
            if cached is None or not stale_ok:
                raise self._requests.no_connection_error()
            return cached
        if cached is not None and self._is_valid(cached, fresh=fresh):
            return cached
        refusal = self._refusals.get(sections)
        if refusal is not None and self._is_valid(refusal, fresh=fresh):
            raise QueryError(refusal.text, code="refused")
        return await self._requests.share(("parameters", sections), lambda: self._request(sections))

    async def fill(self) -> None:
        """Request each section, so that the cache has the server's own answer to every query.

        Do nothing if the server did not send its parameters at the start of the connection.
        """
        everything = self._cached.get(())
        if everything is None or everything.session != self._requests.session:
            return
        for section in SECTIONS:
            try:
                await self.get((section,), fresh=False, stale_ok=False)
            except QueryError as error:
                logger.debug("%s: section %s is not available: %s", self._settings.name, section, error)
                if error.code != "refused":
                    return

    def _is_valid(self, answer: CachedParameters | _Refusal, *, fresh: bool) -> bool:
        """Return whether an answer is of this connection and, for ``fresh``, recent enough."""
        if answer.session != self._requests.session:
            return False
        return not fresh or time.monotonic() - answer.received_s < self._settings.fresh_interval_s

    async def _request(self, sections: Sections) -> CachedParameters:
        """Request some sections; request all parameters if the server does not send single sections."""
        session = self._requests.session
        everything = SendParameters()
        takes_sections = bool(sections) and self._session_without_sections != session
        command = SendParameters(sections) if takes_sections else everything
        try:
            answered, packet = await self._requests.send(
                command, fallback=everything if takes_sections else None
            )
        except QueryError as error:
            if error.code == "refused":
                self._refusals[sections] = _Refusal(str(error), session, time.monotonic())
            raise
        if answered != command:
            self._session_without_sections = session
        if len(packet.body) > LONG_XML_BYTES:
            answer = await asyncio.to_thread(parse_answer, sections, packet.body, session)
        else:
            answer = parse_answer(sections, packet.body, session)
        before, self._cached[sections] = self._cached.get(sections), answer
        if (
            before is None
            or before.session != session
            or answer.without_statistics != before.without_statistics
        ):
            self._handle_change(answer, before)
        return answer

    def _handle_change(self, answer: CachedParameters, before: CachedParameters | None) -> None:
        """Report changed parameters. If only a section was requested, request all of them first."""
        if answer.sections:
            if before is not None and before.session == answer.session:
                self._requests.start(("parameters", ()), lambda: self._request(()))
        elif answer.parsed is not None:
            self._cached = {(): answer}  # every section must be requested again
            self._on_change(answer.xml, answer.parsed)
