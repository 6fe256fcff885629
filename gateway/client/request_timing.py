"""When messages that are missing are requested, and how long others wait for them."""

import math
from typing import Final

from gateway.client.history_requests import REPLY_S

GRACE_S: Final = 0.05
"""How long a message may be late before it is requested: LCM can deliver in another order."""

RETRY_S: Final = 0.1
"""When a request is repeated that brought nothing."""

PATIENCE_S: Final = 60.0
"""How long requests that bring nothing are repeated: as long as a gateway keeps messages by default."""

NOBODY_S: Final = 3.0
"""The same if messages arrive and nobody takes the requests: the gateway is one of an earlier version."""

_MIN_REPLY_S: Final = 0.05

_ESTIMATE_SHARE: Final = 0.3
"""After which share of the patience it shows how much of the past will come."""

_SILENCE_S: Final = 1.0
"""If nothing has arrived for longer, the connection was lost, and patience begins again."""


class RequestTiming:
    """The timing of the requests of one key. All times are seconds of one monotonic clock.

    There are two kinds of patience. What arrives waits for missing messages as long as requests bring some.
    For the past, the time before the first message, that waits ``patience_s`` in all: a past that still comes
    after that would hold up what is live.
    """

    def __init__(self, patience_s: float | None, *, is_past: bool) -> None:
        self.due_s = math.inf
        """When to request something; infinite if nothing is missing."""
        self.is_past = is_past
        """Whether the past is requested, or will be."""
        self._patience_s = math.inf if patience_s is None else patience_s
        self._since_s = 0.0  # since when requests have brought nothing
        self._past_until_s = math.inf  # infinite if nothing waits
        self._num_past = 0  # how many messages of the past have come since something waits for it
        self._heard_s = -math.inf  # when something arrived last
        self._nobody_s = NOBODY_S
        self._pause_until_s = math.inf

    @property
    def is_due(self) -> bool:
        """Whether anything is to be requested, now or later."""
        return self.due_s < math.inf

    # When to request.

    def begin(self, now_s: float, delay_s: float = 0.0) -> None:
        """Request something new after ``delay_s``."""
        self._since_s, self.due_s = now_s, now_s + delay_s

    def request_now(self, now_s: float) -> None:
        """Request something else at once."""
        self._since_s = self.due_s = now_s

    def begin_end(self, now_s: float) -> None:
        """Request what there is until now, unless a request is overdue already."""
        self._since_s, self.due_s = now_s, min(self.due_s, now_s)

    def stop(self) -> None:
        """Request nothing more."""
        self.due_s = math.inf

    def pause(self, until_s: float) -> None:
        """Request nothing until a time, and the past not even then: what is live was handed on meanwhile."""
        self.stop()
        self.end_past()
        self._pause_until_s = until_s

    def is_pause_over(self, now_s: float) -> bool:
        """Whether gaps may be filled again."""
        return now_s >= self._pause_until_s

    def repeat(self, now_s: float, *, has_helped: bool, is_nobody: bool = False) -> bool:
        """Request again what is still missing; return False if that has taken too long.

        ``is_nobody``: messages arrive, and nobody has taken the request.
        """
        if has_helped:
            self._since_s = now_s
        if not self.is_due:
            return True
        if not has_helped and now_s - self._since_s >= (self._nobody_s if is_nobody else PATIENCE_S):
            return False
        self.due_s = now_s if has_helped else now_s + RETRY_S
        return True

    # How long to wait.

    def wait_from(self, now_s: float) -> None:
        """Begin to be patient again: until now, no request could bring anything."""
        self._since_s = now_s

    def hear(self, now_s: float) -> None:
        """Note that something has arrived.

        In an outage, no request can be answered, which says nothing about the history. Without this, the
        first message after a long one would give up the very gap that the outage has made.
        """
        if self.is_due and now_s - self._heard_s > _SILENCE_S:
            self._since_s = now_s
        self._heard_s = now_s

    def note_answer(self) -> None:
        """Note that a gateway has answered."""
        self._nobody_s = NOBODY_S

    def note_nobody(self) -> None:
        """Request everything only once until a gateway answers.

        Otherwise, each gap would hold up the messages of a gateway of an earlier version for NOBODY_S.
        """
        self._nobody_s = 0.0

    @property
    def _expires_s(self) -> float:
        """When to go on without what is missing."""
        if self.is_past:
            return self._past_until_s
        return self._since_s + self._patience_s if self.is_due else math.inf

    def is_expired(self, now_s: float) -> bool:
        """Whether to go on without what is missing."""
        return now_s >= self._expires_s

    def reply_s(self, now_s: float) -> float:
        """Return how long the next answer may take: other keys, of which messages wait, come after it."""
        return min(REPLY_S, self._patience_s, max(self._expires_s - now_s, _MIN_REPLY_S))

    # The past.

    def wait_for_past(self, now_s: float) -> None:
        """Note that a message has arrived, which waits for the past; the first one begins the patience.

        As long as nothing waits, a gateway that is busy may take longer.
        """
        if self._past_until_s == math.inf:
            self._past_until_s, self._num_past = now_s + self._patience_s, 0

    def end_past(self) -> None:
        """Note that the past is there, or given up."""
        self.is_past = False

    def past_still_to_come(self, num_came: int, now_s: float) -> float:
        """Return how many messages of the past can come before the patience is over; ``num_came`` just came.

        Infinite as long as it is too early to say.
        """
        if not self.is_past or self._patience_s == math.inf:
            return math.inf
        self._num_past += num_came
        left_s = max(self._past_until_s - now_s, 0.0)
        taken_s = self._patience_s - left_s
        if taken_s < _ESTIMATE_SHARE * self._patience_s:
            return math.inf
        return int(self._num_past * left_s / taken_s)
