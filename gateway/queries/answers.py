"""Answers: those that need no server, and what a server answers to SendParameters."""

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any, Final, NamedTuple

import rtc3d

from gateway.errors import ParametersError, QueryError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.decode import (
    JSON,
    LCM,
    MAX_JSON_SOURCE_BYTES,
    TEXT,
    decode,
    json_bytes,
    json_text,
    message_type,
)
from gateway.outputs.contract import Answer
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
from gateway.runtime.failures import EventLog
from gateway.session.replies import XmlThread


@cache
def schema_answer(name: str) -> Answer:
    """Return the ``.lcm`` text of a type for lcm-gen; the types that it contains come first."""
    texts = [
        (files("rtc3d") / f"{each}.lcm").read_text(encoding="utf-8") for each in _with_member_types(name)
    ]
    return Answer("\n".join(texts).encode(), TEXT)


def _with_member_types(name: str) -> list[str]:
    """Return the names of all types that a type contains, each once, and then its own."""
    names: dict[str, None] = {}
    for type_name in getattr(rtc3d, name).__typenames__:
        package, _, member = type_name.rpartition(".")
        if package:
            names |= dict.fromkeys(_with_member_types(member))
    return [*names, name]


def message_answer(message: bytes, attachment: Mapping[str, Any]) -> Answer:
    """Return a message of the gateway as it is published."""
    return Answer(message, f"{LCM};rtc3d.{message_type(message).__name__}", attachment)


def parameters_json(parameters: Parameters, section: str) -> bytes | None:
    """Return parameters as JSON with NaN as null: an object of all sections, or the object of one.

    Returns None if the parameters lack ``section``.
    """
    values = {key: section.of(parameters) for key, section in SECTIONS.items()}
    if section:
        return None if values[section] is None else json_text(values[section]).encode()
    return json_text({name: value for name, value in values.items() if value is not None}).encode()


FRAME_KEY: Final = "frame"


def frame_answer(
    frame: CoordinateFrame, names: Mapping[str, Mapping[str, Mapping[str, str]]], options: Mapping[str, str]
) -> Answer:
    """Return the frame, and the names that outputs have given to items, as JSON.

    ``names`` are by output, component key and label. Raises QueryError if there are options.
    """
    if options:
        raise QueryError(f"{FRAME_KEY} takes no options")
    given = {output: of_output for output, of_output in names.items() if of_output}
    return Answer(json_bytes({**frame.facts, "names": given}), JSON)


JSON_RATIO: Final = 8
"""How many times as long as its message a JSON text may be, about."""

_UNMADE_S: Final = 0.1
"""For how long further peers share a payload that is not made yet. Then it may belong to an older frame."""


class JsonPayload:
    """JSON that ``make`` returns, made once; ``num_bytes`` is about its size. It implements LazyPayload."""

    def __init__(self, make: Callable[[], bytes], num_bytes: int) -> None:
        self.num_bytes = num_bytes
        self._make = make
        self._lock = threading.Lock()
        self._made: bytes | None = None

    @property
    def is_made(self) -> bool:
        """See LazyPayload."""
        return self._made is not None

    def make(self) -> bytes:
        """See LazyPayload."""
        with self._lock:
            if self._made is None:
                self._made = self._make()
            return self._made


class FilePayload:
    """The content of a file, which is read anew for each peer. It implements LazyPayload."""

    is_made = False

    def __init__(self, path: Path) -> None:
        """Raise OSError if there is no such file."""
        self.name: str = path.name
        self.num_bytes: int = path.stat().st_size
        self._path = path

    def make(self) -> bytes:
        """See LazyPayload."""
        try:
            return self._path.read_bytes()
        except OSError as error:
            text = f"the C3D file {self.name} cannot be read: {error.strerror}"
            raise QueryError(text, code="nothing-yet") from error


class NewestJson:
    """The JSON texts of the newest messages, one for each key: a message is converted once for all peers.

    While a text waits to be made, peers that ask later share it, so that only one of each key waits.
    """

    def __init__(self) -> None:
        self._newest: dict[str, tuple[bytes, JsonPayload, float]] = {}
        """The message, its text, and when somebody first asked for it."""

    def of(self, key: str, message: bytes) -> tuple[bytes, JsonPayload]:
        """Return the text of ``message``, or of the one before it, together with its message.

        Raises QueryError if the message is too long.
        """
        if key in self._newest:
            newest, payload, asked_s = self._newest[key]
            is_waiting = not payload.is_made and time.monotonic() - asked_s < _UNMADE_S
            if newest == message or is_waiting:
                return newest, payload
        if len(message) > MAX_JSON_SOURCE_BYTES:
            raise QueryError(
                f"a frame of {len(message)} bytes is too long for JSON; ask without format=json",
                code="refused",
            )
        payload = JsonPayload(lambda: json_text(decode(message)).encode(), JSON_RATIO * len(message))
        self._newest[key] = message, payload, time.monotonic()
        return message, payload


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
        self.is_recording = False
        """Whether a peer has started a recording, and none has stopped it."""
        self.end_of_recording: asyncio.Task[None] | None = None
        """Waits for the end of its duration, if it has one."""


class ParametersReading(NamedTuple):
    """Parsed parameters, and how they differ from the former ones."""

    parsed: ParsedParameters
    is_changed: bool
    renamed: str = ""
    changed_sections: Sequence[str] = ()


def read_parameters(xml: bytes, before: ServerAnswer | None) -> ParametersReading:
    """Parse XML and compare it with the former answer. It runs in a thread."""
    if before is None:
        return ParametersReading(parse_parameters(xml), True)
    old = before.parsed
    if differ_in_statistics_only(before.xml, xml):
        return ParametersReading(_with_statistics(old, xml), False)
    parsed = parse_parameters(xml)
    return ParametersReading(
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
