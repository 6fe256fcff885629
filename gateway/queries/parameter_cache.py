"""What is known of a server's parameters: its XML as it came, and the forms made of it."""

import time
from dataclasses import dataclass, field, replace
from functools import cached_property

from gateway.errors import ParametersError
from gateway.queries.answers import parameters_json
from gateway.rtc3d.parameters_xml import ParsedParameters, parse_parameters

Sections = tuple[str, ...]
"""Parameter sections of a question, as in SECTIONS; () for all."""


@dataclass(frozen=True)
class Known:
    """An answer of the server to SendParameters; ``parsed`` is None if nothing could be read from it."""

    sections: Sections
    xml: bytes
    parsed: ParsedParameters | None
    session: int
    came_s: float = field(default_factory=time.monotonic)

    @property
    def age_s(self) -> float:
        """How long ago the server said it."""
        return time.monotonic() - self.came_s

    @cached_property
    def json(self) -> bytes | None:
        """The typed form, built once for all who ask; None if there is nothing in it."""
        if self.parsed is None:
            return None
        return parameters_json(self.parsed.parameters, self.sections[0] if len(self.sections) == 1 else "")

    @cached_property
    def content(self) -> object:
        """What must be equal in two answers for them to say the same: not the statistics (§6.1)."""
        if self.parsed is None:
            return self.xml
        parameters = self.parsed.parameters
        if parameters.general is None:
            return parameters
        return replace(parameters, general=replace(parameters.general, frames_sent=None, frames_per_s=None))


def known_from(sections: Sections, xml: bytes, session: int) -> Known:
    """Return what the server said to a question about ``sections``, all forms of it made."""
    try:
        known = Known(sections, xml, parse_parameters(xml), session)
    except ParametersError:
        return Known(sections, xml, None, session)
    _ = known.json  # made here, where it may take long
    return known
