"""What asking for parameters on Zenoh and on LCM has in common."""

import time
from typing import Final, NamedTuple

from gateway.errors import QueryError

RETRY_S: Final = 0.5
"""How long to wait before a question without a reply is repeated."""

DISCOVERY_S: Final = 2.5
"""How long a gateway may take to be found: links take time, and on LCM a status comes once a second."""

Sections = tuple[str, ...]
"""Members of SECTIONS; () means all."""


class ParametersReply(NamedTuple):
    """The parameters of one source, as XML, reduced to ``sections``.

    ``age_s`` is the time since the gateway received them from the server; None if unknown.
    """

    source: str
    sections: Sections
    xml: bytes
    age_s: float | None


class Replies(NamedTuple):
    """All replies to a question, and what went wrong: codes as in QueryError, and no-gateway."""

    received: list[ParametersReply]
    problems: list[QueryError]


class TimeLimits:
    """Two deadlines that start now: for finding a gateway, and for its replies."""

    def __init__(self, timeout_s: float) -> None:
        start_s = time.monotonic()
        self._timeout_s = timeout_s
        self._end_s = start_s + timeout_s
        self._discovery_end_s = start_s + DISCOVERY_S

    @property
    def left_s(self) -> float:
        """Seconds left for replies; 0 when the time is up."""
        return max(0.0, self._end_s - time.monotonic())

    @property
    def discovery_is_over(self) -> bool:
        """Whether every running gateway should have been found by now."""
        return time.monotonic() >= self._discovery_end_s

    def no_reply(self, subject: str) -> QueryError:
        """Return the error for a gateway that is running but did not reply about ``subject``."""
        return QueryError(
            f"no reply about {subject} within {self._timeout_s:g} s although a gateway is running; "
            "try again, or with a longer --timeout",
            code="timeout",
        )
