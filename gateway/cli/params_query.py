"""What parameter queries on Zenoh and on LCM have in common: replies, problems and time limits."""

import time
from typing import Final, NamedTuple

from gateway.errors import QueryError

RETRY_S: Final = 0.5
"""How long to wait before repeating a query that got no reply, or came while there were too many."""

BUSY_CODES: Final = frozenset({"busy", "rate"})
"""The codes of a gateway that gets too many queries. They count as no reply as long as there is time."""

DISCOVERY_S: Final = 2.5
"""How long it may take to find a gateway: Zenoh needs time to connect; LCM carries one status a second."""

Sections = tuple[str, ...]
"""Keys of SECTIONS (gateway.rtc3d.parameters), such as "3d"; () means all sections."""


class ParametersReply(NamedTuple):
    """The parameters of one source, as XML, reduced to ``sections``.

    ``age_s`` is the time since the gateway received them from the server; None if unknown.
    """

    source: str
    sections: Sections
    xml: bytes
    age_s: float | None


class Replies(NamedTuple):
    """All replies to a query, and the problems; QueryError lists their codes."""

    received: list[ParametersReply]
    problems: list[QueryError]


class TimeLimits:
    """Two time limits, both counted from now: for finding a gateway, and for its replies."""

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
