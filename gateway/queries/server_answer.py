"""What a server answers to SendParameters: the XML, what it says, and how it differs from before."""

import asyncio
import logging
from collections.abc import Sequence
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
from gateway.rtc3d.parameters_xml import MAX_XML_BYTES, ParsedParameters, extract_sections, parse_parameters
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


class QueryHistory:
    """What queries about a source continue when the source is built again, after a reload or a defect.

    See ParameterCache and Recordings.
    """

    def __init__(self, source: str) -> None:
        self.events = EventLog(logger, source)
        """Logs changes of the parameters."""
        self.newest: ServerAnswer | None = None
        """The newest answer for all sections; None before the first, and while the former ones are void."""
        self.version = 0
        """The version of ``newest``; 0 before the first."""
        self.is_named_recording = False
        """Whether a command with a name started the recording, so a command has to stop it."""
        self.end_of_recording: asyncio.Task[None] | None = None
        """Waits for the end of its duration, if it has one."""


class Reading(NamedTuple):
    """Parsed parameters, and how they differ from the former ones."""

    parsed: ParsedParameters
    is_changed: bool
    renamed: str = ""
    changed_sections: Sequence[str] = ()


def read_parameters(xml: bytes, before: ServerAnswer | None) -> Reading:
    """Parse XML and compare it with the former answer. It runs in a thread."""
    if before is None:
        return Reading(parse_parameters(xml), True)
    old = before.parsed
    if differ_in_statistics_only(before.xml, xml):
        return Reading(_with_statistics(old, xml), False)
    parsed = parse_parameters(xml)
    return Reading(
        parsed,
        without_statistics(parsed.parameters) != without_statistics(old.parameters),
        describe_renames(old.parameters, parsed.parameters),
        changed_sections(old.parameters, parsed.parameters),
    )


def _with_statistics(parsed: ParsedParameters, xml: bytes) -> ParsedParameters:
    """Return parsed parameters with the statistics of ``xml``, which is the same otherwise."""
    statistics, old = statistics_xml(xml), parsed.parameters.general
    new = parse_parameters(statistics).parameters.general if statistics else None
    if old is None or new is None:
        return parsed
    general = replace(old, frames_sent=new.frames_sent, frames_per_s=new.frames_per_s)
    return parsed._replace(parameters=replace(parsed.parameters, general=general))
