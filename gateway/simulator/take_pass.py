"""One pass of a take: the moments of its source, as they are read from its files."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

from gateway.errors import ProtocolError
from gateway.messages.decode import decode, prefix_of
from gateway.messages.encode import CONTENT_OFFSET
from gateway.messages.texts import xml_bytes
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.simulator.take_moments import Moment, MomentBuilder, RecordedParameters, is_whole
from gateway.takes.files.reader import TakeMessage, TakeReader

_MAX_LATE_CAPTURE_US: Final = 3_600_000_000
"""A time of capture this far from the arrival is not plausible."""

_RANGE_SLACK_US: Final = 5_000_000
"""Messages of one moment are at most this far apart in a take, so a range is complete after this time."""

_MAX_VERSIONS: Final = 1000
"""How many versions of the parameters are remembered: a faulty server can change them all the time."""


@dataclass(slots=True)
class PlayedSource:
    """The source of a take that is played, and what is known of it before it is read to its end."""

    reader: TakeReader
    source: str
    first_utime: float = -math.inf
    """Earlier events are left out, in µs since 1970."""

    end_utime: float = math.inf
    """This event and later ones are left out, likewise."""

    default: RecordedParameters = field(default_factory=lambda: RecordedParameters(b""))
    """The parameters of components before the first parameters in the take."""

    rates_hz: Mapping[ComponentType, float] = field(default_factory=dict)
    """The measured rates of components."""

    is_reported: bool = False
    """Whether it is in the log what could not be played."""


class TakePass:
    """One reading of the source of a take."""

    def __init__(self, played: PlayedSource) -> None:
        self._played = played
        self._builder = MomentBuilder()
        self._newest: RecordedParameters | None = None
        self._versions: dict[int, RecordedParameters] = {}
        self.first_parameters: RecordedParameters | None = None
        """The first parameters in the take; None if none have been read."""
        self.num_malformed = 0
        """How many messages could not be read."""

    def moments(self) -> Iterator[Moment]:
        """Yield the moments, in order; their times are in µs from the first one. Raises TakeError."""
        played = self._played
        for message in played.reader.messages():
            if message.source != played.source:
                continue
            if message.utime >= played.end_utime + _RANGE_SLACK_US:
                break
            if message.key == "parameters":
                self._take_parameters(message.message)
            elif message.key in COMPONENTS_BY_KEY and played.first_utime <= message.utime < played.end_utime:
                yield from self._take_component(message)
        yield from self._builder.finish()

    def _take_parameters(self, message: bytes) -> None:
        try:
            content = decode(message)
        except ProtocolError:
            self.num_malformed += 1
            return
        xml = xml_bytes(content.xml)
        if not xml:  # the server gives no parameters any more
            self._newest = None
            self._versions.pop(content.parameters_version, None)
            return
        if self._newest is None or self._newest.xml != xml:
            self._newest = RecordedParameters(xml)
            _ = self._newest.rates_hz  # parsing takes long, so it is done in this thread
        self.first_parameters = self.first_parameters or self._newest
        self._versions[content.parameters_version] = self._newest
        if len(self._versions) > _MAX_VERSIONS:
            self._versions = dict(islice(self._versions.items(), _MAX_VERSIONS // 2, None))

    def _take_component(self, message: TakeMessage) -> list[Moment]:
        component = COMPONENTS_BY_KEY[message.key]
        content = message.message[CONTENT_OFFSET:]
        if not is_whole(component, content):
            self.num_malformed += 1
            return []
        prefix = prefix_of(message.message)
        is_plausible = abs(prefix.utime - prefix.capture_utime) < _MAX_LATE_CAPTURE_US
        return self._builder.add(
            component,
            prefix.capture_utime if is_plausible else prefix.utime,
            prefix.session,
            message.message[8:24] + message.message[32:CONTENT_OFFSET],
            content,
            self._versions.get(prefix.parameters_version) or self._newest or self._played.default,
        )
