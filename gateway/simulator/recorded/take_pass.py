"""Reading a take from its beginning to its end: the moments of one source."""

import itertools
from collections.abc import Iterator
from typing import Final

from gateway.errors import ProtocolError
from gateway.messages.decode import decode, prefix_of
from gateway.messages.encode import CONTENT_OFFSET
from gateway.messages.parameters_text import xml_bytes
from gateway.rtc3d.components import COMPONENTS_BY_KEY
from gateway.simulator.recorded.frame_contents import is_whole
from gateway.simulator.recorded.moments import Moment, MomentBuilder, Recorded
from gateway.simulator.recorded.parameters import RecordedParameters
from gateway.takes.reader import TakeMessage, TakeReader

_MAX_LATE_CAPTURE_US: Final = 3_600_000_000
"""A time of capture this far from the arrival is not plausible."""

_RANGE_SLACK_US: Final = 5_000_000
"""Messages of one moment are at most this far apart in a take, so a range is complete after this time."""

_MAX_VERSIONS: Final = 1000
"""How many versions of the parameters are remembered: a faulty server can change them all the time."""


class TakePass:
    """One reading of a take. ``first_utime`` and ``end_utime`` limit its events; None is no limit."""

    def __init__(
        self,
        reader: TakeReader,
        source: str,
        first_utime: int | None,
        end_utime: int | None,
        default: RecordedParameters,
    ) -> None:
        self._reader = reader
        self._source = source
        self._first_utime = first_utime
        self._end_utime = end_utime
        self._builder = MomentBuilder()
        self._newest: RecordedParameters | None = None
        self._versions: dict[int, RecordedParameters] = {}
        self.default = default
        """The parameters of components before the first parameters in the take."""
        self.first_parameters: RecordedParameters | None = None
        """The first parameters in the take; None if none have been read."""
        self.num_malformed = 0
        """How many messages could not be read."""

    def moments(self) -> Iterator[Moment]:
        """Yield the moments, in order; their times are in µs from the first one. Raises TakeError."""
        for message in self._reader.messages():
            if message.source != self._source:
                continue
            if self._end_utime is not None and message.utime >= self._end_utime + _RANGE_SLACK_US:
                break
            if message.key == "parameters":
                self._take_parameters(message.message)
            elif message.key in COMPONENTS_BY_KEY and self._is_in_range(message.utime):
                yield from self._take_component(message)
        yield from self._builder.finish()

    def _is_in_range(self, utime: int) -> bool:
        is_begun = self._first_utime is None or utime >= self._first_utime
        return is_begun and (self._end_utime is None or utime < self._end_utime)

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
            self._versions = dict(itertools.islice(self._versions.items(), _MAX_VERSIONS // 2, None))

    def _take_component(self, message: TakeMessage) -> list[Moment]:
        component = COMPONENTS_BY_KEY[message.key]
        content = message.message[CONTENT_OFFSET:]
        if not is_whole(component, content):
            self.num_malformed += 1
            return []
        prefix = prefix_of(message.message)
        is_plausible = abs(prefix.utime - prefix.capture_utime) < _MAX_LATE_CAPTURE_US
        return self._builder.add(
            Recorded(
                component,
                prefix.capture_utime if is_plausible else prefix.utime,
                prefix.session,
                message.message[8:24] + message.message[32:CONTENT_OFFSET],
                content,
                self._versions.get(prefix.parameters_version) or self._newest or self.default,
            )
        )
