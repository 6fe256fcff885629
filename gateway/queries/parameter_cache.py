"""A server's parameters as cached: its XML as received, and the forms made of it."""

import time
from dataclasses import dataclass, field, replace
from functools import cached_property

from gateway.errors import ParametersError
from gateway.queries.answers import parameters_json
from gateway.rtc3d.parameters_xml import ParsedParameters, parse_parameters

Sections = tuple[str, ...]
"""The parameter sections of a question, as in SECTIONS; () for all."""


@dataclass(frozen=True)
class CachedParameters:
    """A server's answer to SendParameters; ``parsed`` is None if nothing could be read from it."""

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
        """The typed form, built once for all who ask; None if there is nothing in it."""
        if self.parsed is None:
            return None
        return parameters_json(self.parsed.parameters, self.sections[0] if len(self.sections) == 1 else "")

    @cached_property
    def comparable(self) -> object:
        """What two answers must have in common to say the same: everything but the statistics (§6.1)."""
        if self.parsed is None:
            return self.xml
        parameters = self.parsed.parameters
        if parameters.general is None:
            return parameters
        return replace(parameters, general=replace(parameters.general, frames_sent=None, frames_per_s=None))


def parse_answer(sections: Sections, xml: bytes, session: int) -> CachedParameters:
    """Return the server's answer to a question about ``sections``, with all its forms."""
    try:
        cached = CachedParameters(sections, xml, parse_parameters(xml), session)
    except ParametersError:
        return CachedParameters(sections, xml, None, session)
    _ = cached.json  # built here, where it may take long
    return cached
