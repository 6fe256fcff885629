"""The parameters of one source's server as the gateway knows them, and their version."""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final, NamedTuple

from gateway.errors import ParametersError
from gateway.logs.failures import EventLog
from gateway.queries.answers import JsonPayload, parameters_json
from gateway.rtc3d.parameters import (
    SECTIONS,
    Parameters,
    changed_sections,
    describe_renames,
    differ_in_statistics_only,
    statistics_xml,
    without_statistics,
)
from gateway.rtc3d.parameters_xml import (
    MAX_XML_BYTES,
    ParsedParameters,
    extract_sections,
    parse_parameters,
)
from gateway.stream.replies import XmlThread

Sections = tuple[str, ...]
"""The parameter sections of a query, as in SECTIONS; () for all."""

MAX_PARTS: Final = 16
"""How many answers for some of the sections are kept. Peers can ask for 63 different ones."""

logger = logging.getLogger(__name__)


def now_s() -> float:
    """Return the time on the event loop's clock, in s."""
    return asyncio.get_running_loop().time()


@dataclass(frozen=True)
class ServerAnswer:
    """A server's answer to SendParameters for ``sections``.

    ``session`` is the source's number of connections when it arrived, ``version`` that of the parameters.
    ``is_readable`` is False if nothing could be read from the XML; then ``parsed`` is empty.
    """

    sections: Sections
    xml: bytes
    parsed: ParsedParameters
    session: int
    version: int
    is_readable: bool = True
    received_s: float = field(default_factory=now_s)
    _parts: dict[Sections, "ServerAnswer | None"] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @property
    def age_s(self) -> float:
        """How long ago the answer arrived."""
        return now_s() - self.received_s

    @cached_property
    def json(self) -> JsonPayload | None:
        """The parameters as JSON, made once for all queries; None if the answer has none of them."""
        parameters = self.parsed.parameters
        section = self.sections[0] if len(self.sections) == 1 else ""
        if not self.is_readable or (section and SECTIONS[section].of(parameters) is None):
            return None
        return JsonPayload(lambda: parameters_json(parameters, section) or b"", len(self.xml))

    async def part(self, sections: Sections, xml_thread: XmlThread) -> "ServerAnswer | None":
        """Return the answer for some sections, taken from this one in ``xml_thread``.

        Returns None if this answer lacks one of them, or if it is not well-formed. Then only the server
        itself can answer.
        """
        if sections in self._parts:
            return self._parts[sections]
        xml = await xml_thread.process(self.xml, lambda whole: extract_sections(whole, sections))
        answer = None if xml is None else replace(self, sections=sections, xml=xml)
        if len(self._parts) >= MAX_PARTS:
            del self._parts[next(iter(self._parts))]
        self._parts[sections] = answer
        return answer


def unreadable(
    sections: Sections, xml: bytes, session: int, version: int, error: ParametersError
) -> ServerAnswer:
    """Return an answer from which nothing can be read, for peers that ask for it as it is.

    Of XML that is too long to be parsed, it keeps the beginning.
    """
    parsed = ParsedParameters(Parameters(), (str(error),))
    return ServerAnswer(sections, xml[:MAX_XML_BYTES], parsed, session, version, is_readable=False)


Announce = Callable[[ServerAnswer | None, int], Awaitable[None]]
"""Takes new parameters, None if the former ones are void, and their version.

Publishes them, and then marks the frames that follow with the version.
"""


class QueryHistory:
    """What queries about a source continue when the source is built again, after a reload or a defect.

    See KnownParameters and Recordings.
    """

    def __init__(self, source: str) -> None:
        self.events = EventLog(logger, source)
        self.newest: ServerAnswer | None = None
        self.version = 0
        self.is_named_recording = False
        self.end_of_recording: asyncio.Task[None] | None = None


class KnownParameters:
    """The newest parameters of one source's server.

    ``xml_thread`` parses them. The version grows by one whenever they mean something else than before, when
    they become void, and when another frame of poses goes with them.
    """

    def __init__(self, history: QueryHistory, xml_thread: XmlThread, announce: Announce) -> None:
        self._history = history
        self._events = history.events
        self._xml_thread = xml_thread
        self._announce = announce
        self._lock = asyncio.Lock()  # for one change at a time

    @property
    def newest(self) -> ServerAnswer | None:
        """The newest answer for all sections; None before the first, and while the former ones are void."""
        return self._history.newest

    @property
    def version(self) -> int:
        """The version of ``newest``; 0 before the first."""
        return self._history.version

    @property
    def is_void(self) -> bool:
        """Whether there were parameters, and the server gives none now."""
        return self.newest is None and self.version > 0

    async def take(self, xml: bytes, session: int, *, announce_always: bool = False) -> ServerAnswer:
        """Keep an answer for all sections, and announce it if it means something else than the former one.

        Raises ParametersError if nothing can be read from it; then nothing changes.
        """
        async with self._lock:
            before = self.newest
            reading = await self._xml_thread.process(xml, lambda xml: _read(xml, before))
            if reading.is_changed:
                self._history.version += 1
                self._log_change(reading, is_first=before is None)
            self._history.newest = answer = ServerAnswer((), xml, reading.parsed, session, self.version)
            if reading.is_changed or announce_always:
                await self._announce(answer, self.version)
            return answer

    async def share(self, session: int) -> None:
        """Announce the newest parameters again, for a new connection to the same server."""
        async with self._lock:
            if self.newest is not None:
                self._history.newest = replace(self.newest, session=session)
                await self._announce(self.newest, self.version)

    async def begin_version(self) -> None:
        """Announce the parameters as another version, because they go with another frame of poses now."""
        async with self._lock:
            self._history.version += 1
            if self.newest is not None:
                self._history.newest = replace(self.newest, version=self.version)
            await self._announce(self.newest, self.version)

    async def make_void(self, reason: str) -> None:
        """Forget the parameters, because the server does not give any now (field note 23)."""
        async with self._lock:
            if self.newest is None:
                return
            self._history.newest = None
            self._history.version += 1
            self._events.log(
                logging.WARNING,
                f"the server gives no parameters any more: {reason}; the former names and units are void "
                f"(parameters_version {self.version})",
                "void",
            )
            await self._announce(None, self.version)

    def _log_change(self, reading: "_Reading", *, is_first: bool) -> None:
        if is_first:
            if self.version > 1:
                text = f"the server gives parameters again (parameters_version {self.version})"
                self._events.log(logging.INFO, text, "given again")
            return
        if reading.renamed:
            self._events.log(
                logging.WARNING,
                f"markers or tools were renamed on the server: {reading.renamed}; programs that use the "
                f"names need the new ones (parameters_version {self.version})",
                "renamed",
            )
        if reading.changed_sections:
            sections = ", ".join(reading.changed_sections)
            self._events.log(
                logging.INFO,
                f"the server's parameters changed: {sections} (parameters_version {self.version})",
                "changed",
            )


class _Reading(NamedTuple):
    """Parsed parameters, and how they differ from the former ones."""

    parsed: ParsedParameters
    is_changed: bool
    renamed: str = ""
    changed_sections: Sequence[str] = ()


def _read(xml: bytes, before: ServerAnswer | None) -> _Reading:
    """Parse XML and compare it with the former answer. It runs in a thread."""
    if before is None:
        return _Reading(parse_parameters(xml), True)
    old = before.parsed
    if differ_in_statistics_only(before.xml, xml):
        return _Reading(_with_statistics(old, xml), False)
    parsed = parse_parameters(xml)
    return _Reading(
        parsed,
        without_statistics(parsed.parameters) != without_statistics(old.parameters),
        describe_renames(old.parameters, parsed.parameters),
        changed_sections(old.parameters, parsed.parameters),
    )


def _with_statistics(parsed: ParsedParameters, xml: bytes) -> ParsedParameters:
    """Return parsed parameters with the statistics of ``xml``, which is the same otherwise."""
    statistics = statistics_xml(xml)
    old = parsed.parameters.general
    if not statistics or old is None:
        return parsed
    new = parse_parameters(statistics).parameters.general
    if new is None:
        return parsed
    general = replace(old, frames_sent=new.frames_sent, frames_per_s=new.frames_per_s)
    return parsed._replace(parameters=replace(parsed.parameters, general=general))
