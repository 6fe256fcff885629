"""What commands that ask gateways have in common: exit statuses, time limits and repetitions."""

import sys
import time
from collections.abc import Sequence
from typing import Final

import typer

from gateway.errors import QueryError
from gateway.logs.safe_text import safe_lines
from gateway.outputs.discovery import DISCOVERY_S

EXIT_STATUSES: Final = {"no-gateway": 3, "no-connection": 4, "timeout": 5}
"""Exit status by the code of the first problem; 1 for every other code."""

RETRY_S: Final = 0.5
"""How long to wait before repeating a query that got no reply, or came while there were too many."""

BUSY_CODES: Final = frozenset({"busy", "rate"})
"""The codes of a gateway that gets too many queries. They count as no reply as long as there is time."""


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


def exit_with(problems: Sequence[QueryError]) -> None:
    """Print problems, each once, and end with the status of the first one; without any, return."""
    for text in dict.fromkeys(str(problem) for problem in problems):
        print(safe_lines(text), file=sys.stderr)
    if problems:
        raise typer.Exit(EXIT_STATUSES.get(problems[0].code, 1))
