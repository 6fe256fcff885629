"""The messages of one key, handed on in the order of their numbers; what was missed comes from the gateway.

This decides what to hold, what to request and what to hand on. It does no I/O, starts no thread and reads no
clock: ``gateway.client.refill`` requests.
"""

from collections import Counter
from collections.abc import Callable
from typing import Final

from gateway.client.arrived_run import ArrivedRun, HeldBytes
from gateway.client.completion_states import CompletionState, End, Unknown
from gateway.client.delivery import Delivery
from gateway.client.history_requests import (
    COMPLETE,
    KEEPS_NOTHING_CODES,
    RETRY_CODES,
    Completeness,
    HistoryAnswer,
    HistoryRequest,
    NewestRequest,
)
from gateway.client.publisher_watch import PublisherWatch
from gateway.client.request_timing import GRACE_S, RequestTiming
from gateway.client.restart_check import RestartCheck, Verdict
from gateway.messages.history import sequence_of
from gateway.messages.sequence_check import SequenceCheck

PASSING_S: Final = 10.0
"""After a refusal, gaps are not filled for so long: a reload of the gateway may end its reason."""


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

    Gateways publish a key that ``is_steady`` all the time: one that has nothing of it has just been started.
    """

    def __init__(
        self,
        hand_on: Callable[[bytes], object],
        check: SequenceCheck,
        held_bytes: HeldBytes,
        completeness: Completeness = COMPLETE,
        *,
        is_steady: bool = False,
    ) -> None:
        self.problem = ""
        """Why gaps are not filled now; "" if they are."""
        self.last_problem = ""
        """Why gaps were not filled last."""
        self.past_problem = ""
        """Why the past was given up; "" if it came, or may still come."""
        self.unknown: Counter[Unknown] = Counter()
        """In how many places it is not known whether messages are missing."""
        is_past = completeness.last_s is not None
        self._fills_gaps = completeness.is_complete
        self._is_steady = is_steady
        self._state = CompletionState.BEGINNING if self._fills_gaps or is_past else CompletionState.PASSING
        self._end = End.OPEN
        self._delivery = Delivery(hand_on, check, held_bytes)
        self._timing = RequestTiming(completeness.patience_s, is_past=is_past)
        self._newest_request = NewestRequest()
        # BEGINNING: what the history is asked to begin with; None if the first message says it.
        self._first_request = HistoryRequest(0, last_s=completeness.last_s) if is_past else None
        self._restart = RestartCheck(held_bytes)  # CHECKING
        self._watch = PublisherWatch()

    @property
    def due_s(self) -> float:
        """When to request something; infinite if nothing is missing."""
        return self._timing.due_s

    @property
    def is_past(self) -> bool:
        """Whether what is handed on is of the time before the first message, or has waited for it."""
        return self._timing.is_past

    @property
    def reached_utime(self) -> int:
        """The time of the newest message that was handed on; 0 before the first."""
        return self._delivery.reached_utime

    @property
    def num_refilled(self) -> int:
        """How many messages came from the history because they were missing before others that arrived."""
        return self._delivery.num_refilled

    @property
    def num_damaged(self) -> int:
        """How many messages were left out, because the gateway has not published their numbers."""
        return self._delivery.num_damaged

    @property
    def has_begun(self) -> bool:
        """Whether anything has arrived, or was requested."""
        has_arrived = self._delivery.arrived.until >= 0
        return self._state is not CompletionState.BEGINNING or has_arrived or self._timing.is_due

    # What arrives.

    def receive(
        self, message: bytes, sequence: int, utime: int, session: int, now_s: float, *, has_room: bool = True
    ) -> None:
        """Take a message that was published now. ``sequence`` is not negative.

        Unless ``has_room``, it is let go, and is requested later.
        """
        if self._end is not End.OPEN or self._state is CompletionState.ENDED:
            return
        delivery = self._delivery
        if self._state is not CompletionState.PASSING and delivery.recent.utime_of(sequence, -1) == utime:
            return  # it comes again, or late: that shows nothing, however often
        self._watch_publishers(sequence, utime, session, now_s)
        arrived = self._arriving
        # A new run can have reached the same number when it is heard again. Then the time differs.
        is_next_run = not arrived.is_continued_by(sequence, utime, session) or (
            arrived is delivery.arrived and delivery.recent.contradict(sequence, utime)
        )
        if is_next_run and self._state is not CompletionState.PASSING:
            self._suspect_restart(now_s)
        elif is_next_run and self.problem and not self._watch.sees_two(now_s):
            # The gateway that has restarted may keep messages, even if the former one did not. No history
            # says whether it has; but nothing is held, so nothing can be repeated.
            delivery.check.begin_at(0, is_restart=True)
            delivery.begin_run()
            self._resume(now_s)
        if self._state is CompletionState.PASSING:
            if not arrived.is_continued_by(sequence, utime, session):
                delivery.begin_run()
                arrived = delivery.arrived
            arrived.note(sequence, utime, session)
            delivery.hand_on(message)
        else:
            self._keep(message, sequence, utime, session, now_s, has_room=has_room)

    @property
    def _arriving(self) -> ArrivedRun:
        """The run of the messages that arrive: after a suspected restart, a later one."""
        later_runs = self._restart.later_runs
        return later_runs[-1] if later_runs else self._delivery.arrived

    def _keep(
        self, message: bytes, sequence: int, utime: int, session: int, now_s: float, *, has_room: bool
    ) -> None:
        """Hand a message on if it is the next one, or hold it, or let it go."""
        delivery, arrived = self._delivery, self._arriving
        arrived.note(sequence, utime, session)
        self._newest_request.note_arrival(sequence)
        if self.is_past:
            self._timing.wait_for_past(now_s)
        if self._state is CompletionState.BEGINNING and self._first_request is None:
            delivery.next, self._state = sequence, CompletionState.FOLLOWING
            delivery.check.begin_at(sequence)
        if not has_room:
            self._timing.wait_from(now_s)  # nothing is requested until there is room
        elif sequence in arrived.held and arrived.held[sequence] != message:
            # One of the two has a false number, and nothing here says which. The history has the other one.
            delivery.num_damaged += 1
            arrived.release(sequence)
        elif self._state in {CompletionState.BEGINNING, CompletionState.CHECKING} or sequence > delivery.next:
            arrived.hold(sequence, message)
        elif sequence == delivery.next:
            delivery.pass_on(sequence, message)
        self._advance(now_s, is_live=True)
        if self._timing.is_due:
            self.expire(now_s)

    def _advance(self, now_s: float, *, is_live: bool = False) -> None:
        """Hand on what is held and follows, and note when to request what is missing, if it is."""
        delivery = self._delivery
        if self._state in {CompletionState.FOLLOWING, CompletionState.FILLING}:
            while delivery.next in delivery.arrived.held:
                delivery.pass_on(delivery.next, delivery.arrived.release(delivery.next))
            # What was lost last, no later message shows: at the end, only the history knows it.
            if delivery.next <= delivery.arrived.until or self._end is End.ENDING:
                self._state = CompletionState.FILLING
            else:
                self._state, delivery.asks_known = CompletionState.FOLLOWING, True
                self._timing.stop()
                self._end_past()
        is_incomplete = self._state in {CompletionState.FILLING, CompletionState.CHECKING} or (
            self._state is CompletionState.BEGINNING and delivery.arrived.until >= 0
        )
        if is_incomplete and not self._timing.is_due:
            # A message that the network delivers late comes by itself: to request each would cost more.
            is_late = is_live and self._state is CompletionState.FILLING
            self._timing.begin(now_s, GRACE_S if is_late else 0.0)
        if is_live:
            self._timing.hear(now_s)

    def notice(self, newest: int, utime: int, now_s: float) -> None:
        """Take the number and the time of the newest message that the history has: it may never arrive."""
        arrived = self._delivery.arrived
        if (
            self._state not in {CompletionState.FOLLOWING, CompletionState.FILLING}
            or utime <= arrived.newest_utime
        ):
            return
        if newest > arrived.until:
            arrived.until = newest
            self._advance(now_s, is_live=True)  # it may only be on its way
        elif newest <= arrived.newest:
            # Later, but with a smaller number: a restart. If all of the next run fell into an outage, as a
            # short trial does, nothing that arrives will ever show it.
            self._suspect_restart(now_s, has_arrived=False)
            self._advance(now_s)

    # Only passing on.

    def _watch_publishers(self, sequence: int, utime: int, session: int, now_s: float) -> None:
        """Pass messages on while two gateways publish: the numbers of neither say what is missing."""
        self._watch.add(sequence, utime, session, now_s)
        has_two = self._watch.sees_two(now_s)
        if has_two and self._state is not CompletionState.PASSING:
            self.unknown[Unknown.TWO_GATEWAYS] += 1
            self._pass_on_only("two gateways publish it", now_s)
        elif self.problem and self._timing.is_pause_over(now_s) and not has_two:
            self._resume(now_s)

    def _pass_on_only(self, problem: str, until_s: float) -> None:
        """Hand on what is held, and then each message when it arrives."""
        self._delivery.flush(self._restart.take_runs(), has_restarted=False)
        self.problem = self.last_problem = problem
        self._state, self._first_request = CompletionState.PASSING, None
        self._timing.pause(until_s)
        self._newest_request.revoke()

    def _resume(self, now_s: float) -> None:
        """Fill gaps again, from the newest message on."""
        self.problem = ""
        self._delivery.resume()
        self._state = CompletionState.FOLLOWING
        self._timing.wait_from(now_s)

    # What is requested.

    def begin(self, now_s: float) -> None:
        """Request the time before the first message now: the gateway has some of it."""
        if self.is_past and not self._timing.is_due:
            self._timing.begin(now_s)

    def begin_since(self, utime: int, now_s: float) -> None:
        """Request what was published since a time: a first message may have fallen into an outage."""
        if not self.has_begun and self._first_request is None:
            self._first_request = HistoryRequest(0, since_utime=utime)
            self._timing.begin(now_s)

    def reply_s(self, now_s: float) -> float:
        """Return how long the next answer may take: other keys, of which messages wait, come after it."""
        return self._timing.reply_s(now_s)

    def expire(self, now_s: float) -> None:
        """Go on without what is missing, if that takes too long. Call it often while something is due."""
        if self._timing.is_expired(now_s):
            self._give_up(now_s)

    def request(self) -> HistoryRequest:
        """Return what to request; only if something is due."""
        number = self._newest_request.make()
        if self._state is CompletionState.CHECKING:
            return self._restart.request(number, self._delivery)
        if self._state is CompletionState.BEGINNING:
            return (self._first_request or HistoryRequest(0))._replace(number=number)
        return self._delivery.request(number, knows_last=self._end is not End.ENDING)

    def answer(self, request: HistoryRequest, answer: HistoryAnswer, now_s: float) -> None:
        """Take the answer to a request."""
        if not self._newest_request.is_same(request):
            return
        self._timing.note_answer()
        if self._state is CompletionState.CHECKING:
            self._take_verdict(request, answer, now_s)
        elif request.is_contradicted_by(answer):
            # Only a restart explains that, or a false number that was handed on. The number of the known
            # message was in this request: go on with the question for its time.
            self._suspect_restart(now_s, has_arrived=False)
            self._restart.begin(asks_for_time=True)
        elif self._delivery.is_of_this_run(request, answer, self._newest_request.newest_of(answer)):
            self._take(request, answer, now_s)
        elif self._delivery.reached is not None:
            self._suspect_restart(now_s, has_arrived=False)
        else:
            # Nothing of the run was handed on, so there is no message to ask for: another restart, whose
            # numbers are past those that are held.
            self._begin_run(answer, now_s, is_held_before=True)

    def _take(self, request: HistoryRequest, answer: HistoryAnswer, now_s: float) -> None:
        """Hand on, or hold, what the history has."""
        delivery, former = self._delivery, self._delivery.next
        if self._state is CompletionState.BEGINNING:
            delivery.next = min([answer.first, *delivery.arrived.held])
            self._state, self._first_request = CompletionState.FILLING, None
        if former < 0 or self._end is End.ENDING:
            delivery.arrived.until = max(delivery.arrived.until, answer.newest)
        if self._end is End.ENDING:
            self._end = End.KNOWN
        delivery.take(request, answer)
        delivery.shorten_past(self._timing.past_still_to_come(len(answer.messages), now_s))
        has_helped = delivery.next != former
        if not has_helped and request.asks_known and answer.last < delivery.next <= answer.newest:
            # The known message is so long that an answer has only that: each would bring it again.
            delivery.asks_known = False
            has_helped = True
        self._advance(now_s)
        self._repeat(now_s, has_helped=has_helped)

    def fail(
        self, request: HistoryRequest, code: str, text: str, now_s: float, *, is_connected: bool = True
    ) -> None:
        """Take the error of a request: the code of the gateway, or no-gateway if nobody takes requests.

        Unless the subscriber ``is_connected``, the gateway may have never got the request.
        """
        if not self._newest_request.is_same(request):
            return
        if code in RETRY_CODES:
            # Without a connection, nobody takes a request either: only if messages arrive, the gateway is one
            # of an earlier version. What has made the request shows a connection, however long none follows.
            has_arrived = self._state is CompletionState.CHECKING or self._asks_for_first
            is_nobody = code == "no-gateway" and (is_connected or has_arrived)
            was_past = self.is_past
            is_over = not self._repeat(
                now_s, has_helped=False, is_nobody=is_nobody, knows_end=is_nobody and is_connected
            )
            if is_over and was_past:
                self.past_problem = text
            if is_over and code == "no-gateway":
                self._timing.note_nobody()
        elif code == "nothing-yet" and self._lacks_what_arrived:
            self._begin_run(None, now_s)
        elif code == "nothing-yet":
            if self._is_steady and self._end is not End.OPEN and self._delivery.reached is not None:
                self.unknown[Unknown.RESTART] += 1
            self._give_up(now_s, knows_end=True)
        else:
            if self._end is not End.OPEN:
                self._end = End.KNOWN
                self.unknown[Unknown.END] += code not in KEEPS_NOTHING_CODES
            self._pass_on_only(text, now_s + PASSING_S)

    @property
    def _lacks_what_arrived(self) -> bool:
        """Whether a history without messages is of yet another run: of this one, some have arrived.

        Of a key with few messages, all may have expired: then one restart too many is reported.
        """
        delivery = self._delivery
        return (
            self._state is CompletionState.FILLING
            and delivery.reached is None
            and delivery.arrived.newest >= 0
        )

    @property
    def _asks_for_first(self) -> bool:
        """Whether the history is asked for the first messages of a key that came later than others."""
        return self._first_request is not None and self._first_request.since_utime is not None

    def _repeat(
        self, now_s: float, *, has_helped: bool, is_nobody: bool = False, knows_end: bool = False
    ) -> bool:
        """Request again what is still missing; give it up and return False if that takes too long."""
        if self._timing.repeat(now_s, has_helped=has_helped, is_nobody=is_nobody):
            return True
        self._give_up(now_s, knows_end=knows_end)
        return False

    def _give_up(self, now_s: float, *, knows_end: bool = False) -> None:
        """Go on with the next message that there is."""
        self._timing.stop()
        arrived = self._delivery.arrived
        if self._state is CompletionState.CHECKING:
            # Nobody denies the restart that the numbers show. If they are false, the past is not repeated
            # either: the history does not answer.
            self._begin_run(None, now_s)
            return
        if self._state is CompletionState.BEGINNING:
            self.unknown[Unknown.BEGINNING] += self._asks_for_first and not knows_end
            self._first_request = None
            if arrived.until >= 0:
                self._delivery.next, self._state = arrived.first, CompletionState.FOLLOWING
        elif self.is_past:
            self._delivery.skip_past_to(arrived.first)
        else:
            self._delivery.skip_to(arrived.first)
        if self._end is End.ENDING:
            self._end = End.KNOWN
            self.unknown[Unknown.END] += not knows_end
        self._advance(now_s)
        self._end_past()

    def _end_past(self) -> None:
        """Go on with what arrives now; without filling gaps, if that is not wanted."""
        if self.is_past and not self._fills_gaps:
            self._flush()
            self._state = CompletionState.PASSING
            self._timing.stop()
            self._newest_request.revoke()  # the past may still come: it would be handed on after what is live
        self._timing.end_past()

    # Restarts.

    def _suspect_restart(self, now_s: float, *, has_arrived: bool = True) -> None:
        """Ask the history whether the gateway has restarted; a message ``has_arrived`` that says so."""
        if has_arrived:
            self._restart.add_run()
            if self._restart.has_too_many_runs:
                self._pass_on_only("the numbers of its messages have no order", now_s + PASSING_S)
                return
        if self._state is not CompletionState.CHECKING:
            self._state = CompletionState.CHECKING
            self._restart.begin()
            self._timing.request_now(now_s)
        self._newest_request.revoke()  # its answer may be of before the restart, and would deny it

    def _take_verdict(self, request: HistoryRequest, answer: HistoryAnswer, now_s: float) -> None:
        """Go on as an answer of the history says."""
        newest = self._newest_request.newest_of(answer)
        verdict = self._restart.judge(request, answer, self._delivery, newest)
        if verdict is Verdict.ASK_AGAIN:
            self._repeat(now_s, has_helped=False)
        elif verdict is Verdict.ASK_FOR_TIME:
            self._timing.request_now(now_s)
        elif verdict is Verdict.RESTARTED:
            self._begin_run(answer, now_s)
        else:
            if verdict is Verdict.FALSE_NUMBER:
                self._delivery.correct_known(sequence_of(answer.messages[0]))
            self._restart.rejoin(self._delivery, newest)
            self._state = CompletionState.BEGINNING if self._delivery.next < 0 else CompletionState.FILLING
            self._timing.request_now(now_s)
            self._advance(now_s)

    def _begin_run(self, answer: HistoryAnswer | None, now_s: float, *, is_held_before: bool = False) -> None:
        """Go on with the numbers of the gateway that has restarted, which has given this answer, if any."""
        new = self._restart.take_new_run(self._delivery, answer, is_held_before=is_held_before)
        after_utime = self._restart.time_before(self._delivery, new, answer)
        self.unknown[Unknown.RESTART] += 1 + len(self._restart.later_runs)
        self._flush()
        self._delivery.check.begin_at(0, is_restart=True)
        self._delivery.begin_run(new, after_utime=after_utime)
        self._newest_request.revoke()
        if self._end is End.KNOWN:
            self._end = End.ENDING  # that was the end of the former run
        self._state, self._first_request = CompletionState.FOLLOWING, None
        self._timing.stop()
        self._advance(now_s)
        self._end_past()

    def _flush(self) -> None:
        """Hand on what is held, each run after the other."""
        self._delivery.flush(self._restart.take_runs(), has_restarted=True)

    # The end.

    def end(self, now_s: float) -> None:
        """Take nothing more that is published, and request everything until now."""
        if self._state in {CompletionState.PASSING, CompletionState.ENDED} or not self.has_begun:
            return
        if self._end is End.OPEN:
            self._end = End.ENDING
        self._timing.begin_end(now_s)
        self._advance(now_s)

    def abandon(self) -> None:
        """Hand on what is held, and request nothing more."""
        if self._state is not CompletionState.PASSING:
            self._flush()
        self.unknown[Unknown.END] += self._end is End.ENDING
        self._state = CompletionState.ENDED
        self._timing.stop()
        self._newest_request.revoke()
