"""The messages of one key, handed on in the order of their numbers; what was missed comes from the gateway.

This decides what to hold, what to request and what to hand on. It does no I/O, starts no thread and reads no
clock: ``gateway.client.refill`` requests.
"""

import math
from collections.abc import Callable, Collection, Sequence
from typing import Final

from gateway.client.history_requests import (
    BUSY_CODES,
    COMPLETE,
    REPLY_S,
    RETRY_CODES,
    Completeness,
    HistoryAnswer,
    HistoryRequest,
)
from gateway.messages.history import sequence_of, utime_of
from gateway.messages.sequence_check import MAX_LATE, SequenceCheck

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
_SAFE_SHARE: Final = 0.5
"""After which share of the patience it shows how much of the past will come; how much of that to count on."""

_SILENCE_S: Final = 1.0
"""If nothing has arrived for longer, the connection was lost, and patience begins again."""

MAX_HELD_BYTES: Final = 32 * 1024 * 1024
"""How much all series of a subscriber hold together while they wait: 20 s of a dense stream at 1000 Hz."""

_ENTRY_BYTES: Final = 128
"""What a held message takes besides its content."""


class HeldBytes:
    """How much the series of a subscriber hold together, and how much they may."""

    def __init__(self, limit: int = MAX_HELD_BYTES) -> None:
        self.limit = limit
        self.used = 0


class Completion:
    """Completes the messages of one key.

    It calls ``hand_on`` with each message, in the order of the numbers of each run of the gateway. What is
    handed on is counted in ``check``, which is also told what no message shows.

    While messages are missing, later ones are held. Those for which there is no room are let go, and are
    requested again when it is their turn; the first one is always held. ``due_s`` is when to request
    something; then ``request`` says what, and ``answer`` or ``fail`` takes what came of it. All times are
    seconds of one monotonic clock.
    """

    def __init__(
        self,
        hand_on: Callable[[bytes], object],
        check: SequenceCheck,
        held_bytes: HeldBytes,
        completeness: Completeness = COMPLETE,
    ) -> None:
        self.is_past = completeness.last_s is not None
        """Whether what is handed on is of the time before the first message, or has waited for it."""
        self.due_s = math.inf
        """When to request something; infinite if nothing is missing."""
        self.reached_utime = 0
        """The time of the newest message that was handed on; 0 before the first."""
        self.num_refilled = 0
        """How many messages came from the history because they were missing before others that arrived."""
        self.problem = ""
        """Why messages are only passed on; "" if gaps are filled."""
        self._hand_on = hand_on
        self._check = check
        self._held_bytes = held_bytes
        self._fills_gaps, self._last_s = completeness.is_complete, completeness.last_s
        self._patience_s = math.inf if completeness.patience_s is None else completeness.patience_s
        self._past_until_s = math.inf  # when to give up the time before the first message
        self._num_past = 0  # how many messages of it have come
        self._arrivals = SequenceCheck()  # of what arrives, in that order
        self._held: dict[int, bytes] = {}
        self._run = 0
        self._next: int | None = None  # the number to hand on next; None before the first one
        self._next_utime: int | None = None  # the time of the message before it, if it is to be compared
        self._until = -1  # the largest number that is known to exist
        self._newest = -1  # the largest number of this run that has arrived, its time and its session
        self._newest_utime = 0
        self._newest_session = 0
        self._nobody_s = NOBODY_S
        self._since_s = 0.0  # since when requests have brought nothing
        self._heard_s = -math.inf
        self._is_ending = self._knows_end = False

    # What arrives.

    def receive(
        self, message: bytes, sequence: int, utime: int, session: int, now_s: float, *, has_room: bool = True
    ) -> None:
        """Take a message that was published now. ``sequence`` is not negative.

        Unless ``has_room``, it is let go, and is requested later.
        """
        if self._is_ending:
            return
        self._arrivals.add(sequence, utime, session)
        if self._arrivals.has_two_publishers:
            if not self.problem:
                self._pass_on_only("two gateways publish it")
        elif self._is_restart(sequence, utime, session):
            self._begin_run((), now_s)
        self._until = max(self._until, sequence)
        if sequence > self._newest:
            self._newest, self._newest_utime, self._newest_session = sequence, utime, session
        if self._passes_on:
            self._hand_on(message)
            return
        if self._next is None and self._last_s is None:
            self._next = sequence
        if has_room:
            self._pass_or_hold(sequence, message)
        else:
            self._since_s = now_s  # patience begins when requests can be made again
        self._look(now_s, is_live=True)
        self.expire(now_s)

    @property
    def _passes_on(self) -> bool:
        """Whether each message is handed on when it arrives."""
        return bool(self.problem) or not (self._fills_gaps or self.is_past)

    def _is_restart(self, sequence: int, utime: int, session: int) -> bool:
        """Whether a message shows that the gateway has restarted, and is not only late."""
        if utime > self._newest_utime:
            return sequence <= self._newest or session < self._newest_session
        return self._newest - sequence > MAX_LATE

    def _pass_or_hold(self, sequence: int, message: bytes) -> None:
        if sequence == self._next:
            self._pass(sequence, message)
        elif self._next is None or sequence > self._next:
            self._hold(sequence, message)

    def _hold(self, sequence: int, message: bytes) -> None:
        room = self._held_bytes
        num_bytes = len(message) + _ENTRY_BYTES
        if sequence not in self._held and (not self._held or room.used + num_bytes <= room.limit):
            self._held[sequence] = message
            room.used += num_bytes

    def _release(self, sequence: int) -> bytes:
        message = self._held.pop(sequence)
        self._held_bytes.used -= len(message) + _ENTRY_BYTES
        return message

    def _pass(self, sequence: int, message: bytes) -> None:
        self._next, self._next_utime = sequence + 1, utime_of(message)
        self.reached_utime = self._next_utime
        self._hand_on(message)

    @property
    def _is_missing(self) -> bool:
        return self._until >= 0 if self._next is None else self._next <= self._until

    def _look(self, now_s: float, *, is_live: bool = False) -> None:
        """Hand on what is held and follows, and note when to request what is missing, if it is."""
        if self._passes_on:
            return
        while self._next is not None and self._next in self._held:
            self._pass(self._next, self._release(self._next))
        if not self._is_missing and not (self._is_ending and not self._knows_end):
            self.due_s = math.inf
            if self.is_past and self._next is not None:
                self._end_past()
        elif self.due_s == math.inf:
            self._begin_to_request(now_s, now_s + (GRACE_S if is_live and self._next is not None else 0.0))
        elif is_live and now_s - self._heard_s > _SILENCE_S:
            self._since_s = now_s
        if is_live:
            self._heard_s = now_s

    # What is requested.

    def begin(self, now_s: float) -> None:
        """Request the time before the first message now: the gateway has some of it."""
        if self.is_past and self.due_s == math.inf:
            self._begin_to_request(now_s, now_s)

    def _begin_to_request(self, now_s: float, due_s: float) -> None:
        self._since_s, self.due_s = now_s, due_s
        if self.is_past:
            self._past_until_s = now_s + self._patience_s

    @property
    def _expires_s(self) -> float:
        """When to go on without what is missing."""
        if self.is_past:
            return self._past_until_s
        return self._since_s + self._patience_s if self.due_s < math.inf else math.inf

    def reply_s(self, now_s: float) -> float:
        """Return how long the next answer may take."""
        return min(REPLY_S, max(self._expires_s - now_s, _MIN_REPLY_S))

    def expire(self, now_s: float) -> None:
        """Go on without what is missing, if that takes too long. Call it often while something is due."""
        if now_s >= self._expires_s:
            self._give_up(now_s)

    def request(self) -> HistoryRequest:
        """Return what to request; only if something is due."""
        if self._next is None:
            return HistoryRequest(self._run, last_s=self._last_s)
        known = None
        if self._next_utime is not None and self._next:
            known = (self._next - 1, self._next_utime)
        last = None
        if not self._is_ending or self._knows_end:
            last = min(self._held, default=self._until + 1) - 1
        return HistoryRequest(self._run, self._next, last, known=known)

    def answer(self, request: HistoryRequest, answer: HistoryAnswer, now_s: float) -> None:
        """Take the answer to a request."""
        if request.run != self._run or self._passes_on:
            return
        numbered = [(sequence_of(message), message) for message in answer.messages]
        if self._is_of_other_run(numbered, request.known):
            self._pass_by(min(map(utime_of, answer.messages)), answer.newest, now_s)
            return
        self._nobody_s = NOBODY_S
        former = self._next
        if former is None:
            self._next = min([answer.first, *self._held])
        if former is None or (self._is_ending and not self._knows_end):
            self._until = max(self._until, answer.newest)
            self._knows_end = self._is_ending
        for number, message in numbered:
            if answer.is_whole:
                self._skip_to(number)
            self._refill(number, message)
        if answer.is_whole:
            last = answer.last if request.last is None else min(answer.last, request.last)
            self._skip_to(last + 1)
        if self.is_past and self._patience_s < math.inf:
            self._num_past += len(numbered)
            self._shorten_past(now_s)
        has_helped = self._next != former
        if not has_helped and request.known is not None:
            self._next_utime = None  # the known message may be so long that an answer has only that
            has_helped = True
        self._look(now_s)
        self._repeat(now_s, has_helped=has_helped)

    def _is_of_other_run(self, numbered: Sequence[tuple[int, bytes]], known: tuple[int, int] | None) -> bool:
        """Whether the gateway has restarted, and its numbers are past those of before.

        Then it has another message with a known number. If it has none of these, its messages are newer than
        what is held and has a larger number.
        """
        first = min(self._held, default=-1)
        first_utime = utime_of(self._held[first]) if self._held else 0
        utimes = {number: utime_of(message) for number, message in numbered}
        if known is not None and known[0] in utimes:
            return utimes[known[0]] != known[1]
        return any(
            utime > first_utime if number < first else number == first and utime != first_utime
            for number, utime in utimes.items()
        )

    def _refill(self, number: int, message: bytes) -> None:
        """Take a message of the history, which may be one that has arrived meanwhile."""
        if number == self._next:
            self.num_refilled += number < self._newest  # later ones were not missed
            if number in self._held:
                self._release(number)
            self._pass(number, message)
        elif self._next is not None and number > self._next and number not in self._held:
            self._hold(number, message)
            self.num_refilled += number in self._held and number < self._newest

    def _skip_to(self, number: int) -> None:
        """Go on at a number: what is missing before it exists no more."""
        if self._next is not None and number > self._next:
            for each in sorted(each for each in self._held if each < number):
                self._hand_on(self._release(each))
            self._next, self._next_utime = number, None

    def _shorten_past(self, now_s: float) -> None:
        """Leave out the beginning of the past if all of it would take too long.

        What is missing directly before the live messages would be worse for a display.
        """
        left_s = max(self._past_until_s - now_s, 0.0)
        taken_s = self._patience_s - left_s
        if self._next is None or taken_s < _ESTIMATE_SHARE * self._patience_s:
            return
        num_possible = int(self._num_past * left_s / taken_s)
        first = min(self._held, default=self._until + 1)
        if first - self._next > num_possible:
            self._skip_past(first - int(_SAFE_SHARE * num_possible))

    def _skip_past(self, number: int) -> None:
        """Go on at a number, of the past or the first that is live: nobody has missed those before it."""
        self._check.skip(number)
        self._skip_to(number)

    def fail(
        self, request: HistoryRequest, code: str, text: str, now_s: float, *, is_connected: bool = True
    ) -> None:
        """Take the error of a request: the code of the gateway, or no-gateway if nobody takes requests.

        Unless the subscriber ``is_connected``, the gateway may have never got the request.
        """
        if request.run != self._run or self._passes_on:
            return
        if code in RETRY_CODES:
            patience_s = self._nobody_s if code == "no-gateway" and is_connected else PATIENCE_S
            if self._is_ending and not self._is_missing and code not in BUSY_CODES:
                patience_s = 0.0
            if not self._repeat(now_s, has_helped=False, patience_s=patience_s) and code == "no-gateway":
                self._nobody_s = 0.0  # until somebody takes a request, each is made once
        elif code == "nothing-yet":
            self._give_up(now_s)
        else:
            self._pass_on_only(text)

    def _repeat(self, now_s: float, *, has_helped: bool, patience_s: float = PATIENCE_S) -> bool:
        """Request again what is still missing; give it up and return False if that takes too long."""
        if has_helped:
            self._since_s = now_s
        if self.due_s < math.inf:
            if now_s - self._since_s >= patience_s and not has_helped:
                self._give_up(now_s)
                return False
            self.due_s = now_s if has_helped else now_s + RETRY_S
        return True

    def _give_up(self, now_s: float) -> None:
        """Go on with the next message that there is."""
        self._knows_end = self._is_ending
        if self._next is None:
            self._last_s = None
            self._next = min(self._held, default=None)
        else:
            first = min(self._held, default=self._until + 1)
            (self._skip_past if self.is_past else self._skip_to)(first)
        self.due_s = math.inf
        self._look(now_s)
        self._end_past()

    def _end_past(self) -> None:
        """Go on with what arrives now; without filling gaps, if that is not wanted."""
        if self.is_past and not self._fills_gaps:
            self._flush()
            self.due_s = math.inf
        self.is_past = False

    # Restarts and the end.

    def _begin_run(self, held: Collection[int], now_s: float) -> None:
        """Go on with the numbers of a gateway that has restarted; ``held`` are those that belong to it."""
        self._flush(held)
        self._run += 1
        self.problem = ""
        self._next, self._next_utime = 0, None
        self._until = max(held, default=-1)
        if not held:
            self._newest, self._newest_session = -1, 0
        self.due_s = math.inf
        self._look(now_s)
        self._end_past()

    def _pass_by(self, utime: int, newest: int, now_s: float) -> None:
        """Go on with the numbers of a gateway that has restarted, and is past those of before.

        ``utime`` is the time of one of its messages, and ``newest`` the number of its newest one.
        """
        self._begin_run([number for number, held in self._held.items() if utime_of(held) >= utime], now_s)
        self._until = max(self._until, newest)
        self._knows_end = self._is_ending
        self._look(now_s)

    def _flush(self, kept: Collection[int] = ()) -> None:
        """Hand on what is held and not ``kept``; what is missing there is lost."""
        for number in sorted(self._held.keys() - set(kept)):
            self._hand_on(self._release(number))
        if self._next is not None and not kept:
            self._check.end(self._until + 1)

    def _pass_on_only(self, problem: str) -> None:
        self._flush()
        self.problem, self.is_past = problem, False
        self._next = self._next_utime = self._last_s = None
        self.due_s = math.inf

    def end(self, now_s: float) -> None:
        """Take nothing more that is published, and request everything until now."""
        if not self._passes_on and self._next is not None:
            self._is_ending = True
            self.due_s = min(self.due_s, now_s)
            self._since_s = now_s

    def abandon(self) -> None:
        """Hand on what is held, and request nothing more."""
        if not self._passes_on:
            self._flush()
        self._is_ending = True
        self._run += 1
        self._next, self.due_s = None, math.inf
