"""The messages of one key, handed on in the order of their numbers; what was missed comes from the gateway.

This decides what to hold, what to request and what to hand on. It does no I/O, starts no thread and reads no
clock: ``gateway.client.refill`` requests.
"""

import enum
import math
from collections import Counter
from collections.abc import Callable
from typing import Final

from gateway.client.arrived_run import ArrivedRun, HeldBytes, RecentTimes
from gateway.client.history_requests import (
    COMPLETE,
    REPLY_S,
    RETRY_CODES,
    Completeness,
    HistoryAnswer,
    HistoryRequest,
)
from gateway.client.publisher_watch import PublisherWatch
from gateway.messages.history import sequence_of, utime_of
from gateway.messages.sequence_check import SequenceCheck

GRACE_S: Final = 0.05
"""How long a message may be late before it is requested: LCM can deliver in another order."""

RETRY_S: Final = 0.1
"""When a request is repeated that brought nothing."""

PATIENCE_S: Final = 60.0
"""How long requests that bring nothing are repeated: as long as a gateway keeps messages by default."""

NOBODY_S: Final = 3.0
"""The same if messages arrive and nobody takes the requests: the gateway is one of an earlier version."""

PASSING_S: Final = 10.0
"""After a refusal, gaps are not filled for so long: a reload of the gateway may end its reason."""

_KEEPS_NOTHING: Final = frozenset({"disabled", "bad-request"})
"""The codes of a gateway without a history."""

_MIN_REPLY_S: Final = 0.05

_ESTIMATE_SHARE: Final = 0.3
_SAFE_SHARE: Final = 0.5
"""After which share of the patience it shows how much of the past will come; how much of that to count on."""

_SILENCE_S: Final = 1.0
"""If nothing has arrived for longer, the connection was lost, and patience begins again."""

_MAX_RUNS: Final = 1000
"""How many restarts in a row may wait to be checked: the numbers come from the network."""


class State(enum.Enum):
    """What a Completion does with a message that arrives."""

    BEGINNING = enum.auto()
    """The number to begin with is not known: the first message says it, or the history if that is asked."""
    FOLLOWING = enum.auto()
    """Nothing is missing: hand on the next number."""
    FILLING = enum.auto()
    """Some are missing, and requested: hold the later ones."""
    CHECKING = enum.auto()
    """The numbers look as if the gateway had restarted: hold what arrives until the history has said so."""
    PASSING = enum.auto()
    """Gaps are not filled: hand on each message when it arrives."""
    ENDED = enum.auto()
    """Take nothing more."""


class Unknown(enum.Enum):
    """Places where nobody knows whether messages are missing."""

    RESTART = "restart"
    """Between two runs of the gateway: what it published last, or while it was not heard, went with it."""
    TWO_GATEWAYS = "two gateways"
    BEGINNING = "beginning"
    """Before the first message of a key that came later than others: the history has not answered."""
    END = "end"
    """After the last message: the history has not answered."""


class Completion:
    """Completes the messages of one key.

    It calls ``hand_on`` with each message, in the order of the numbers of each run of the gateway. What is
    handed on is counted in ``check``, which is also told what no message shows.

    While messages are missing, later ones are held. Those for which there is no room are let go, and are
    requested again when it is their turn; the first one is always held. ``due_s`` is when to request
    something; then ``request`` says what, and ``answer`` or ``fail`` takes what came of it. All times are
    seconds of one monotonic clock.

    A restart of the gateway is believed only if the history no longer has the last known message. A message
    whose number the history does not know was damaged, or is of another program, and is left out.
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
        self.num_damaged = 0
        """How many messages were left out, because the gateway has not published their numbers."""
        self.problem = ""
        """Why gaps are not filled now; "" if they are."""
        self.last_problem = ""
        """Why gaps were not filled last."""
        self.unknown: Counter[Unknown] = Counter()
        """In how many places it is not known whether messages are missing."""
        self._hand_on = hand_on
        self._check = check
        self._held_bytes = held_bytes
        self._fills_gaps = completeness.is_complete
        self._state = State.BEGINNING
        self._watch = PublisherWatch()
        self._run = ArrivedRun(held_bytes)
        self._next = -1  # the number to hand on next; -1 if the history is to say where to begin
        self._reached: tuple[int, int] | None = None  # the message of this run that was handed on last
        self._recent = RecentTimes()
        self._requested = 0  # the number of the newest request
        self._newest_since = -1  # the largest number that has arrived since that
        self._since_s = 0.0  # since when requests have brought nothing
        self._heard_s = -math.inf
        self._nobody_s = NOBODY_S
        # BEGINNING: where the history is to begin, if it is asked.
        self._last_s = completeness.last_s
        self._begin_utime: int | None = None
        # FILLING: the known message may be so long that an answer has only that; and a new run begins later
        # than the former one has ended, so that no mistake repeats the past.
        self._asks_known = True
        self._after_utime: int | None = None
        # CHECKING: what has arrived since the numbers went back, and whether the time is asked.
        self._later_runs: list[ArrivedRun] = []
        self._checks_time = False
        # PASSING: until when.
        self._passes_until_s = math.inf
        # The end: nothing that arrives is taken, and the number to end with may not be known yet.
        self._is_ending = self._knows_end = False
        # The past: when to give it up, if anything waits for it, and how much has come since that waits.
        self._patience_s = math.inf if completeness.patience_s is None else completeness.patience_s
        self._past_until_s = math.inf
        self._num_past = 0
        if not (self._fills_gaps or self.is_past):
            self._state = State.PASSING

    @property
    def has_begun(self) -> bool:
        """Whether anything has arrived, or was requested."""
        return self._state is not State.BEGINNING or self._run.until >= 0 or self.due_s < math.inf

    # What arrives.

    def receive(
        self, message: bytes, sequence: int, utime: int, session: int, now_s: float, *, has_room: bool = True
    ) -> None:
        """Take a message that was published now. ``sequence`` is not negative.

        Unless ``has_room``, it is let go, and is requested later.
        """
        if self._is_ending or self._state is State.ENDED:
            return
        if self._state is not State.PASSING and self._recent.utime_of(sequence, -1) == utime:
            return  # it comes again, or late: that shows nothing, however often
        self._watch_publishers(sequence, utime, session, now_s)
        run = self._later_runs[-1] if self._later_runs else self._run
        is_next_run = not run.is_continued_by(sequence, utime, session) or (
            run is self._run and self._recent.contradict(sequence, utime)
        )
        if is_next_run and self._state is not State.PASSING:
            self._suspect_restart(now_s)
        elif is_next_run and self.problem and not self._watch.sees_two(now_s):
            self._check.begin_at(0, is_restart=True)
            self._run = ArrivedRun(self._held_bytes)
            self._resume(now_s)  # the gateway that has restarted may keep messages
        if self._state is State.PASSING:
            self._pass_on(run, message, sequence, utime, session)
        else:
            self._keep(message, sequence, utime, session, now_s, has_room=has_room)

    def _keep(
        self, message: bytes, sequence: int, utime: int, session: int, now_s: float, *, has_room: bool
    ) -> None:
        """Hand a message on if it is the next one, or hold it, or let it go."""
        run = self._later_runs[-1] if self._later_runs else self._run
        run.note(sequence, utime, session)
        self._newest_since = max(self._newest_since, sequence)
        if self.is_past and self._past_until_s == math.inf:  # the first message that waits
            self._past_until_s, self._num_past = now_s + self._patience_s, 0
        if self._state is State.BEGINNING and self.due_s == math.inf and self._last_s is None:
            self._next, self._state = sequence, State.FOLLOWING
            self._check.begin_at(sequence)
        if not has_room:
            self._since_s = now_s  # patience begins when requests can be made again
        elif sequence in run.held and run.held[sequence] != message:
            self.num_damaged += 1  # one of both; the history has the other one
            run.release(sequence)
        elif self._state in {State.BEGINNING, State.CHECKING} or sequence > self._next:
            run.hold(sequence, message)
        elif sequence == self._next:
            self._pass(sequence, message)
        self._look(now_s, is_live=True)
        self.expire(now_s)

    def _pass_on(self, run: ArrivedRun, message: bytes, sequence: int, utime: int, session: int) -> None:
        if not run.is_continued_by(sequence, utime, session):
            self._run = run = ArrivedRun(self._held_bytes)
        run.note(sequence, utime, session)
        self._hand_on(message)

    def _pass(self, sequence: int, message: bytes) -> None:
        self.reached_utime = utime = utime_of(message)
        self._next, self._reached = sequence + 1, (sequence, utime)
        self._asks_known, self._after_utime = True, None
        self._recent.add(sequence, utime)
        self._hand_on(message)

    def _look(self, now_s: float, *, is_live: bool = False) -> None:
        """Hand on what is held and follows, and note when to request what is missing, if it is."""
        held = self._run.held
        if self._state in {State.FOLLOWING, State.FILLING}:
            while self._next in held:
                self._pass(self._next, self._run.release(self._next))
            if self._next <= self._run.until or (self._is_ending and not self._knows_end):
                self._state = State.FILLING
            else:
                self._state, self.due_s, self._asks_known = State.FOLLOWING, math.inf, True
                self._end_past()
        is_incomplete = self._state in {State.FILLING, State.CHECKING} or (
            self._state is State.BEGINNING and self._run.until >= 0
        )
        if self.due_s == math.inf:
            if is_incomplete:
                is_late = is_live and self._state is State.FILLING
                self._begin_to_request(now_s, now_s + (GRACE_S if is_late else 0.0))
        elif is_live and now_s - self._heard_s > _SILENCE_S:
            self._since_s = now_s
        if is_live:
            self._heard_s = now_s

    def notice(self, newest: int, utime: int, now_s: float) -> None:
        """Take the number and the time of the newest message that the history has: it may never arrive."""
        run = self._run
        if self._state not in {State.FOLLOWING, State.FILLING} or utime <= run.newest_utime:
            return
        if newest > run.until:
            run.until = newest
            self._look(now_s, is_live=True)  # it may only be on its way
        elif newest <= run.newest:
            self._suspect_restart(now_s, has_arrived=False)
            self._look(now_s)

    # Only passing on.

    def _watch_publishers(self, sequence: int, utime: int, session: int, now_s: float) -> None:
        """Pass messages on while two gateways publish: the numbers of neither say what is missing."""
        self._watch.add(sequence, utime, session, now_s)
        has_two = self._watch.sees_two(now_s)
        if has_two and self._state is not State.PASSING:
            self.unknown[Unknown.TWO_GATEWAYS] += 1
            self._pass_on_only("two gateways publish it", now_s)
        elif self.problem and now_s >= self._passes_until_s and not has_two:
            self._resume(now_s)

    def _pass_on_only(self, problem: str, until_s: float) -> None:
        """Hand on what is held, and then each message when it arrives."""
        self._flush(has_restarted=False)
        self.problem = self.last_problem = problem
        self._passes_until_s = until_s
        self.is_past, self._last_s = False, None
        self._state, self.due_s = State.PASSING, math.inf
        self._requested += 1

    def _resume(self, now_s: float) -> None:
        """Fill gaps again, from the newest message on."""
        run = self._run
        self.problem = ""
        self._state, self._next, self._since_s = State.FOLLOWING, run.newest + 1, now_s
        self._reached = (run.newest, run.newest_utime) if run.newest >= 0 else None
        self._recent.clear()

    # What is requested.

    def begin(self, now_s: float) -> None:
        """Request the time before the first message now: the gateway has some of it."""
        if self.is_past and self.due_s == math.inf:
            self._begin_to_request(now_s, now_s)

    def begin_since(self, utime: int, now_s: float) -> None:
        """Request what was published since a time: a first message may have fallen into an outage."""
        if not self.has_begun and self._last_s is None:
            self._begin_utime = utime
            self._begin_to_request(now_s, now_s)

    def _begin_to_request(self, now_s: float, due_s: float) -> None:
        self._since_s, self.due_s = now_s, due_s

    @property
    def _expires_s(self) -> float:
        """When to go on without what is missing."""
        if self.is_past:
            return self._past_until_s
        return self._since_s + self._patience_s if self.due_s < math.inf else math.inf

    def reply_s(self, now_s: float) -> float:
        """Return how long the next answer may take: other keys, of which messages wait, come after it."""
        return min(REPLY_S, self._patience_s, max(self._expires_s - now_s, _MIN_REPLY_S))

    def expire(self, now_s: float) -> None:
        """Go on without what is missing, if that takes too long. Call it often while something is due."""
        if now_s >= self._expires_s:
            self._give_up(now_s)

    def request(self) -> HistoryRequest:
        """Return what to request; only if something is due."""
        self._requested += 1
        self._newest_since = -1
        number, known = self._requested, self._reached
        if self._state is State.CHECKING:
            known = known or (self._run.newest, self._run.newest_utime)
            if self._checks_time:
                return HistoryRequest(number, since_utime=known[1], known=known)
            return HistoryRequest(number, known[0], known[0], known=known, asks_known=True)
        if self._state is State.BEGINNING:
            return HistoryRequest(number, last_s=self._last_s, since_utime=self._begin_utime)
        last = None
        if self._run.held:
            last = self._run.first  # which shows whether that is of this run, and has its own number
        elif self._knows_end or not self._is_ending:
            last = self._run.until
        if self._after_utime is not None:
            return HistoryRequest(number, self._next, last, since_utime=self._after_utime)
        return HistoryRequest(number, self._next, last, known=known, asks_known=self._asks_known)

    def answer(self, request: HistoryRequest, answer: HistoryAnswer, now_s: float) -> None:
        """Take the answer to a request."""
        if request.number != self._requested:
            return
        self._nobody_s = NOBODY_S
        if self._state is State.CHECKING:
            self._check_run(request, answer, now_s)
        elif request.is_contradicted_by(answer):
            # Only a restart, or a message with a false number that was handed on, explains that.
            self._suspect_restart(now_s, has_arrived=False)
            self._checks_time = True
        else:
            self._take(request, answer, now_s)

    def _take(self, request: HistoryRequest, answer: HistoryAnswer, now_s: float) -> None:
        """Hand on, or hold, what the history has."""
        run, former = self._run, self._next
        numbered = [(sequence_of(message), message) for message in answer.messages]
        if not self._confirms(request, answer, now_s):
            return
        if self._state is State.BEGINNING:
            self._next = min([answer.first, *run.held])
            self._state = State.FILLING
        if former < 0 or (self._is_ending and not self._knows_end):
            run.until = max(run.until, answer.newest)
            self._knows_end = self._is_ending
        if request.since_utime is not None and answer.is_whole:
            self._skip_to(answer.first)
        for number, message in numbered:
            if answer.is_whole:
                self._skip_to(number)
            self._refill(number, message)
        if answer.is_whole:
            self._skip_to((answer.last if request.last is None else min(answer.last, request.last)) + 1)
        if self.is_past and self._patience_s < math.inf:
            self._num_past += len(numbered)
            self._shorten_past(now_s)
        has_helped = self._next != former
        if not has_helped and request.asks_known and answer.last < self._next <= answer.newest:
            self._asks_known = False  # it is so long that an answer has only that
            has_helped = True
        self._look(now_s)
        self._repeat(now_s, has_helped=has_helped)

    def _confirms(self, request: HistoryRequest, answer: HistoryAnswer, now_s: float) -> bool:
        """Return whether an answer can be of this run, and leave out what it shows to be damaged."""
        run = self._run
        numbered = [(sequence_of(message), message) for message in answer.messages]
        newest = max(answer.newest, self._newest_since)
        if request.is_confirmed_by(answer) or any(run.held.get(each[0]) == each[1] for each in numbered):
            self._leave_out_beyond(newest)
        elif run.is_older_than(numbered, newest):
            if self._reached is not None:
                self._suspect_restart(now_s, has_arrived=False)
            else:  # another restart, whose numbers are past those that are held
                self._begin_run(answer, now_s, is_held_before=True)
            return False
        return True

    def _refill(self, number: int, message: bytes) -> None:
        """Take a message of the history, which may be one that has arrived meanwhile."""
        run = self._run
        if number == self._next:
            if number in run.held:
                if run.release(number) != message:
                    self.num_damaged += 1
                    run.let_go_between(number, math.inf)  # more of them may be damaged
            else:
                self.num_refilled += number < run.newest  # later ones were not missed
            self._pass(number, message)
        elif number > self._next and run.hold(number, message):
            self.num_refilled += number < run.newest

    def _skip_to(self, number: int) -> None:
        """Go on at a number: what is missing before it exists no more."""
        if number > self._next:
            held = self._run.held
            for each in sorted(each for each in held if each < number):
                self._pass(each, self._run.release(each))
            self._next, self._after_utime = number, None

    def _leave_out_beyond(self, newest: int) -> None:
        """Leave out what has arrived with numbers that the gateway has not published."""
        run = self._run
        if run.until <= newest:
            return
        for number in [number for number in run.held if number > newest]:
            run.release(number)
            self.num_damaged += 1
        run.until = newest
        if run.newest > newest and self._reached is not None:
            run.newest, run.newest_utime = self._reached

    def _shorten_past(self, now_s: float) -> None:
        """Leave out the beginning of the past if all of it would take too long.

        What is missing directly before the live messages would be worse for a display.
        """
        left_s = max(self._past_until_s - now_s, 0.0)
        taken_s = self._patience_s - left_s
        if taken_s < _ESTIMATE_SHARE * self._patience_s:
            return
        num_possible = int(self._num_past * left_s / taken_s)
        first = self._run.first
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
        if request.number != self._requested:
            return
        if code in RETRY_CODES:
            # What has just arrived shows that there is a connection, however long nothing follows.
            has_arrived = self._state is State.CHECKING or self._begin_utime is not None
            is_nobody = code == "no-gateway" and (is_connected or has_arrived)
            if (
                not self._repeat(
                    now_s,
                    has_helped=False,
                    patience_s=self._nobody_s if is_nobody else PATIENCE_S,
                    knows_end=is_nobody and is_connected,
                )
                and code == "no-gateway"
            ):
                self._nobody_s = 0.0  # until somebody takes a request, each is made once
        elif code == "nothing-yet":
            self._give_up(now_s, knows_end=True)
        else:
            if self._is_ending:
                self._knows_end = True
                self.unknown[Unknown.END] += code not in _KEEPS_NOTHING
            self._pass_on_only(text, now_s + PASSING_S)

    def _repeat(
        self, now_s: float, *, has_helped: bool, patience_s: float = PATIENCE_S, knows_end: bool = False
    ) -> bool:
        """Request again what is still missing; give it up and return False if that takes too long."""
        if has_helped:
            self._since_s = now_s
        if self.due_s < math.inf:
            if now_s - self._since_s >= patience_s and not has_helped:
                self._give_up(now_s, knows_end=knows_end)
                return False
            self.due_s = now_s if has_helped else now_s + RETRY_S
        return True

    def _give_up(self, now_s: float, *, knows_end: bool = False) -> None:
        """Go on with the next message that there is."""
        self.due_s = math.inf
        if self._state is State.CHECKING:
            self._begin_run(None, now_s)  # as the numbers say
            return
        if self._state is State.BEGINNING:
            self.unknown[Unknown.BEGINNING] += self._begin_utime is not None and not knows_end
            self._last_s = self._begin_utime = None
            if self._run.until >= 0:
                self._next, self._state = self._run.first, State.FOLLOWING
        else:
            first = self._run.first
            (self._skip_past if self.is_past else self._skip_to)(first)
        if self._is_ending and not self._knows_end:
            self._knows_end = True
            self.unknown[Unknown.END] += not knows_end
        self._look(now_s)
        self._end_past()

    def _end_past(self) -> None:
        """Go on with what arrives now; without filling gaps, if that is not wanted."""
        if self.is_past and not self._fills_gaps:
            self._flush()
            self._state, self.due_s = State.PASSING, math.inf
        self.is_past = False

    # Restarts.

    def _suspect_restart(self, now_s: float, *, has_arrived: bool = True) -> None:
        """Ask the history whether the gateway has restarted; a message ``has_arrived`` that says so."""
        if has_arrived:
            self._later_runs.append(ArrivedRun(self._held_bytes))
            if len(self._later_runs) > _MAX_RUNS:
                self._pass_on_only("the numbers of its messages have no order", now_s + PASSING_S)
                return
        if self._state is not State.CHECKING:
            self._state, self._checks_time = State.CHECKING, False
            self._since_s = self.due_s = now_s
        self._requested += 1  # an answer from before this would not say it

    def _check_run(self, request: HistoryRequest, answer: HistoryAnswer, now_s: float) -> None:
        """Decide by an answer of the history whether the gateway has restarted."""
        if not self._checks_time:
            if request.is_confirmed_by(answer):
                self._continue_run(answer.newest, now_s)
            elif not answer.is_whole:
                self._repeat(now_s, has_helped=False)
            else:
                # The known number may be false. A restart does not change when a message was published.
                self._checks_time = True
                self._since_s = self.due_s = now_s
            return
        if not answer.is_whole:
            self._repeat(now_s, has_helped=False)
            return
        assert request.known is not None  # noqa: S101 - it is what was asked
        number, utime = request.known
        first = answer.messages[0] if answer.messages else None
        if first is not None and utime_of(first) == utime:
            self._correct_number(sequence_of(first))
            self._continue_run(answer.newest, now_s)
        elif first is not None and sequence_of(first) > number and self._is_consistent(number, answer):
            self._continue_run(answer.newest, now_s)  # it goes on where the known message is too old
        else:
            self._begin_run(answer, now_s)

    def _is_consistent(self, number: int, answer: HistoryAnswer) -> bool:
        """Whether an answer with later messages than a known one can be of the same run."""
        numbered = [(sequence_of(message), message) for message in answer.messages]
        is_older = self._run.is_older_than(numbered, max(answer.newest, self._newest_since))
        return not is_older and all(run.newest > number for run in self._later_runs)

    def _correct_number(self, number: int) -> None:
        """Take this as the number of the known message: the other one was damaged."""
        if self._reached is not None:
            false_number, utime = self._reached
            while number + 1 != false_number and self._recent.has(number + 1):
                number += 1  # it was handed on after the messages that it is a copy of
            self._check.correct(number)
            self._reached, self._next = (number, self._recent.utime_of(number, utime)), number + 1
        self._run.newest = number

    def _continue_run(self, newest: int, now_s: float) -> None:
        """Go on as before: the gateway has not restarted."""
        newest = max(newest, self._newest_since)
        run, later_runs, self._later_runs = self._run, self._later_runs, []
        self._leave_out_beyond(newest)
        for later in later_runs:
            run.let_go_between(later.first, later.newest_utime)
            if later.until <= newest:
                run.until = max(run.until, later.until)
            for number in sorted(later.held):
                message = later.release(number)
                if number <= newest and number >= self._next:
                    run.hold(number, message)
                    run.note(number, utime_of(message), run.newest_session)
                else:
                    self.num_damaged += 1
        self._state = State.BEGINNING if self._next < 0 else State.FILLING
        self._since_s = self.due_s = now_s
        self._look(now_s)

    def _begin_run(self, answer: HistoryAnswer | None, now_s: float, *, is_held_before: bool = False) -> None:
        """Go on with the numbers of the gateway that has restarted, which has given this answer, if any."""
        later_runs = self._later_runs
        utimes = [] if answer is None else [utime_of(message) for message in answer.messages]
        known_utime = self._run.newest_utime if self._reached is None else self._reached[1]
        if later_runs:
            run = later_runs.pop()
        elif is_held_before and utime_of(self._run.held[self._run.first]) >= min(utimes):
            run = ArrivedRun(self._held_bytes)  # the clock was set back
        elif utimes:  # its numbers are past those of before, or nothing of it has arrived
            run = self._run.split(lambda utime: utime >= min(utimes))
        else:
            run = self._run.split(lambda utime: utime < known_utime)
        # What is requested of it begins after the former runs, so that no mistake repeats the past.
        former = [utime_of(held) for each in (self._run, *later_runs) for held in each.held.values()]
        reached_utime = max(former, default=0) if self._reached is None else self._reached[1]
        later_utimes = [*utimes, *([run.newest_utime] if run.newest >= 0 else [])]
        is_clock_set_back = min(later_utimes, default=0) <= reached_utime
        after_utime = max([reached_utime, *former]) + 1 if utimes and not is_clock_set_back else None
        self.unknown[Unknown.RESTART] += 1 + len(later_runs)
        self._flush()
        self._check.begin_at(0, is_restart=True)
        self._requested += 1
        self._run, self._knows_end = run, False
        if answer is not None and not run.held:
            run.until = max(run.until, answer.newest)
        self._next, self._reached, self._asks_known, self._after_utime = 0, None, True, after_utime
        self._recent.clear()
        self._state, self.due_s = State.FOLLOWING, math.inf
        self._look(now_s)
        self._end_past()

    def _flush(self, *, has_restarted: bool = True) -> None:
        """Hand on what is held; what is missing there is lost. ``has_restarted``: so has each later run."""
        later_runs, self._later_runs = self._later_runs, []
        for run in (self._run, *later_runs):
            if has_restarted and run is not self._run:
                self._check.begin_at(0, is_restart=True)
            for number in sorted(run.held):
                self._hand_on(run.release(number))
            if has_restarted or not later_runs:
                self._check.end(run.until + 1)

    # The end.

    def end(self, now_s: float) -> None:
        """Take nothing more that is published, and request everything until now."""
        if self._state in {State.PASSING, State.ENDED} or not self.has_begun:
            return
        self._is_ending = True
        self.due_s = min(self.due_s, now_s)
        self._since_s = now_s
        self._look(now_s)

    def abandon(self) -> None:
        """Hand on what is held, and request nothing more."""
        if self._state is not State.PASSING:
            self._flush()
        self.unknown[Unknown.END] += self._is_ending and not self._knows_end
        self._state, self.due_s = State.ENDED, math.inf
        self._requested += 1
