"""Requests to a gateway's history, and the answers; docs/reference/queries.md describes them."""

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from gateway.errors import ProtocolError

REPLY_S: Final = 2.0
"""How long an answer may take. The gateway drops those to a peer that reads too slowly."""

BUSY_CODES: Final = frozenset({"busy", "rate"})
"""The codes of a gateway that gets too many queries: the same one may be answered a little later."""

RETRY_CODES: Final = BUSY_CODES | {"timeout", "no-gateway", "zenoh"}
"""With these codes, the same request may be answered later; a gateway answered none with the last three."""


class Completeness(NamedTuple):
    """What comes from the history: what is missing, if it ``is_complete``, and at first ``last_s`` seconds.

    ``patience_s`` is how long messages that have arrived wait for the first seconds, and for missing ones
    while none of these comes; None: as long as a gateway may need.
    """

    is_complete: bool = False
    last_s: float | None = None
    patience_s: float | None = None


INCOMPLETE: Final = Completeness()
COMPLETE: Final = Completeness(is_complete=True)


class HistoryRequest(NamedTuple):
    """A request for messages from ``first`` to ``last`` (None: the newest), or of ``last_s`` seconds.

    ``known`` is the number and the time of a message that was handed on, if it should be among them. ``run``
    is which run of the gateway the numbers belong to.
    """

    run: int
    first: int = 0
    last: int | None = None
    last_s: float | None = None
    known: tuple[int, int] | None = None

    @property
    def options(self) -> Mapping[str, str]:
        """The options of the query."""
        if self.last_s is not None:
            return {"last_s": f"{self.last_s:.3f}"}
        first = self.first if self.known is None else self.known[0]
        return {"from": str(first)} | ({} if self.last is None else {"to": str(self.last)})


class HistoryAnswer(NamedTuple):
    """Messages in the order of their numbers: all that exist from ``first`` to ``last``, if it ``is_whole``.

    Otherwise, some were lost on their way. ``newest`` is the number of the newest message of the key.
    """

    messages: Sequence[bytes]
    first: int
    last: int
    newest: int
    is_whole: bool = True


def history_answer(
    facts: Mapping[str, Any], messages: Sequence[bytes], *, is_whole: bool = True
) -> HistoryAnswer:
    """Return messages as the answer that the gateway's ``facts`` describe. Raises ProtocolError."""
    first, last, newest = (facts.get(name) for name in ("from", "to", "newest"))
    if not (isinstance(first, int) and isinstance(last, int) and isinstance(newest, int)):
        raise ProtocolError("an answer with messages from the history does not say which they are")
    return HistoryAnswer(messages, first, last, newest, is_whole)
