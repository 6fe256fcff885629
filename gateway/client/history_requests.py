"""Requests to a gateway's history, and the answers; docs/reference/queries.md describes them."""

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from gateway.errors import ProtocolError
from gateway.messages.history import sequence_of, utime_of

REPLY_S: Final = 2.0
"""How long an answer may take. The gateway drops those to a peer that reads too slowly."""

BUSY_CODES: Final = frozenset({"busy", "rate"})
"""The codes of a gateway that gets too many queries: the same one may be answered a little later."""

RETRY_CODES: Final = BUSY_CODES | {"timeout", "no-gateway", "zenoh"}
"""With these codes, the same request may be answered later; a gateway answered none with the last three."""

KEEPS_NOTHING_CODES: Final = frozenset({"disabled", "bad-request"})
"""The codes of a gateway without a history."""


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
    """A request for messages from ``first`` to ``last`` (None: the newest).

    It begins with the message that was handed on last, if ``asks_known``, or instead of ``first`` at a time
    (``since_utime``) or ``last_s`` seconds ago. ``number`` is its own number: only the answer to the newest
    request counts.
    """

    number: int
    first: int = 0
    last: int | None = None
    last_s: float | None = None
    since_utime: int | None = None
    known: tuple[int, int] | None = None
    """The number and the time of a message that the gateway has published, if one is known."""
    asks_known: bool = False

    @property
    def options(self) -> Mapping[str, str]:
        """The options of the query."""
        if self.last_s is not None:
            return {"last_s": f"{self.last_s:.3f}"}
        end = {} if self.last is None else {"to": str(self.last)}
        if self.since_utime is not None:
            return {"since_utime": str(self.since_utime)} | end
        first = self.known[0] if self.asks_known and self.known is not None else self.first
        return {"from": str(first)} | end

    def is_contradicted_by(self, answer: "HistoryAnswer") -> bool:
        """Whether an answer is of a gateway that has not published the known message with its number."""
        if self.known is None:
            return False
        number, utime = self.known
        if answer.newest < number:
            return True
        return any(sequence_of(each) == number and utime_of(each) != utime for each in answer.messages)

    def fits(self, answer: "HistoryAnswer") -> bool:
        """Whether an answer shows that it is of the gateway that has published the known message, if any."""
        if self.known is None:
            return True
        if self.since_utime is not None:
            return bool(answer.messages) and utime_of(answer.messages[0]) == self.known[1]
        return self.is_confirmed_by(answer) if self.asks_known else not self.is_contradicted_by(answer)

    def is_confirmed_by(self, answer: "HistoryAnswer") -> bool:
        """Whether an answer has the known message."""
        return self.known is not None and any(
            (sequence_of(each), utime_of(each)) == self.known for each in answer.messages
        )


class HistoryAnswer(NamedTuple):
    """Messages in the order of their numbers: all that exist from ``first`` to ``last``, if it ``is_whole``.

    Otherwise, some were lost on their way. ``newest`` is the number of the newest message of the key.
    """

    messages: Sequence[bytes]
    first: int
    last: int
    newest: int
    is_whole: bool = True


class NewestRequest:
    """The newest request of one key: only its answer counts."""

    def __init__(self) -> None:
        self._number = 0
        self._newest_since = -1  # the largest number of a message that has arrived since it was made

    def make(self) -> int:
        """Return the number of a new request, which is the newest from now on."""
        self._number += 1
        self._newest_since = -1
        return self._number

    def revoke(self) -> None:
        """Ignore an answer that is on its way: what it was for has changed."""
        self._number += 1

    def is_same(self, request: HistoryRequest) -> bool:
        """Return whether this is the request, and it was not revoked."""
        return request.number == self._number

    def note_arrival(self, sequence: int) -> None:
        """Note that a message has arrived."""
        self._newest_since = max(self._newest_since, sequence)

    def newest_of(self, answer: HistoryAnswer) -> int:
        """Return the largest number that the gateway has published: some can have overtaken the answer."""
        return max(answer.newest, self._newest_since)


def history_answer(
    facts: Mapping[str, Any], messages: Sequence[bytes], *, is_whole: bool = True
) -> HistoryAnswer:
    """Return messages as the answer that the gateway's ``facts`` describe. Raises ProtocolError."""
    first, last, newest = (facts.get(name) for name in ("from", "to", "newest"))
    if not (isinstance(first, int) and isinstance(last, int) and isinstance(newest, int)):
        raise ProtocolError("an answer with messages from the history does not say which they are")
    return HistoryAnswer(messages, first, last, newest, is_whole)
