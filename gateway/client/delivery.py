"""Handing on the messages of one run of a gateway after the other, each run in the order of its numbers."""

import math
from collections.abc import Callable
from typing import Final

from gateway.client.arrived_run import ArrivedRun, HeldBytes, RecentTimes
from gateway.client.history_requests import HistoryAnswer, HistoryRequest
from gateway.messages.history import sequence_of, utime_of
from gateway.messages.sequence_check import SequenceCheck

_SAFE_SHARE: Final = 0.5
"""How much to count on of the messages of the past that can still come in time."""


class Delivery:
    """What has arrived of the present run of a gateway, and what of it was handed on.

    ``hand_on`` is called with each message, and counts it in ``check``; this tells ``check`` what no message
    shows. ``begin_run`` forgets the former run: its numbers and times say nothing about the next one.
    """

    def __init__(
        self, hand_on: Callable[[bytes], object], check: SequenceCheck, held_bytes: HeldBytes
    ) -> None:
        self.hand_on = hand_on
        self.check = check
        self.reached_utime = 0
        """The time of the newest message that was handed on in order; 0 before the first."""
        self.num_refilled = 0
        """How many messages came from the history because they were missing before others that arrived."""
        self.num_damaged = 0
        """How many messages were left out, because the gateway has not published their numbers."""
        # Of the present run:
        self.arrived: ArrivedRun
        """What has arrived, and waits."""
        self.next: int
        """The number to hand on next; negative if the history is to say where to begin."""
        self.reached: tuple[int, int] | None
        """The number and the time of the message that was handed on last."""
        self.recent: RecentTimes
        """The messages that were handed on last."""
        self.asks_known: bool
        """Whether requests begin with the message that was handed on last: it shows the run of the answer."""
        self._after_utime: int | None
        """After which time to request the first messages; None if ``next`` says where to begin."""
        self._held_bytes = held_bytes
        self.begin_run(next_number=-1)

    @property
    def known(self) -> tuple[int, int]:
        """The number and the time of a message of this run."""
        return self.reached or (self.arrived.newest, self.arrived.newest_utime)

    def begin_run(
        self, arrived: ArrivedRun | None = None, next_number: int = 0, after_utime: int | None = None
    ) -> None:
        """Go on with another run, of which this has ``arrived``.

        Its first messages are requested by their time, later than ``after_utime``, if that is known: if the
        restart was a mistake, a request by number would repeat the past as if it were live.
        """
        self.arrived = arrived or ArrivedRun(self._held_bytes)
        self.next, self._after_utime = next_number, after_utime
        self.reached, self.asks_known = None, True
        self.recent = RecentTimes()

    def resume(self) -> None:
        """Go on with the newest message, after messages were handed on as they arrived."""
        arrived = self.arrived
        self.begin_run(arrived, arrived.newest + 1)
        self.reached = self.known if arrived.newest >= 0 else None

    # Handing on.

    def pass_on(self, number: int, message: bytes) -> None:
        """Hand on the message with this number, after all before it."""
        self.reached_utime = utime = utime_of(message)
        self.next, self.reached = number + 1, (number, utime)
        self.asks_known, self._after_utime = True, None
        self.recent.add(number, utime)
        self.hand_on(message)

    def skip_to(self, number: int) -> None:
        """Go on at a number: what is missing before it exists no more."""
        if number > self.next:
            for each in sorted(each for each in self.arrived.held if each < number):
                self.pass_on(each, self.arrived.release(each))
            self.next, self._after_utime = number, None

    def skip_past_to(self, number: int) -> None:
        """Go on at a number, of the past or the first that is live: nobody has missed those before it."""
        self.check.skip(number)
        self.skip_to(number)

    def shorten_past(self, num_possible: float) -> None:
        """Leave out the beginning of the past if only so many messages of it can come in time.

        A gap directly before the live messages would be worse: a plot begins again there, and shows nothing.
        """
        first = self.arrived.first
        if first - self.next > num_possible:
            self.skip_past_to(first - int(_SAFE_SHARE * num_possible))

    def take(self, request: HistoryRequest, answer: HistoryAnswer) -> None:
        """Hand on, or hold, what an answer of the history has.

        If it is whole, the numbers that it lacks exist no more. Of another one, LCM may have lost those: they
        are requested again.
        """
        if request.since_utime is not None and answer.is_whole:
            self.skip_to(answer.first)
        for message in answer.messages:
            if answer.is_whole:
                self.skip_to(sequence_of(message))
            self._refill(sequence_of(message), message)
        if answer.is_whole:
            self.skip_to((answer.last if request.last is None else min(answer.last, request.last)) + 1)

    def _refill(self, number: int, message: bytes) -> None:
        """Take a message of the history, which may be one that has arrived meanwhile."""
        arrived = self.arrived
        if number == self.next:
            if number in arrived.held:
                if arrived.release(number) != message:
                    self.num_damaged += 1
                    arrived.let_go_between(number, math.inf)  # more of them may be damaged
            else:
                self.num_refilled += number < arrived.newest  # later ones were not missed
            self.pass_on(number, message)
        elif number > self.next and arrived.hold(number, message):
            self.num_refilled += number < arrived.newest

    def flush(self, later_runs: list[ArrivedRun], *, has_restarted: bool) -> None:
        """Hand on what is held, also of later runs; what is missing there is lost.

        Unless the gateway ``has_restarted``, nobody knows which run the later numbers belong to.
        """
        for arrived in (self.arrived, *later_runs):
            if has_restarted and arrived is not self.arrived:
                self.check.begin_at(0, is_restart=True)
            for number in sorted(arrived.held):
                self.hand_on(arrived.release(number))
            if has_restarted or not later_runs:
                self.check.end(arrived.until + 1)

    # What is missing.

    def request(self, number: int, *, knows_last: bool) -> HistoryRequest:
        """Return the request with this number for what is missing next; unless it ``knows_last``, for all."""
        last = self.arrived.until if knows_last else None
        if self.arrived.held:
            # Not the number before: the answer then has what is held, too, which shows whether that is of the
            # same run, and whether it has its own number.
            last = self.arrived.first
        if self._after_utime is not None:
            return HistoryRequest(number, self.next, last, since_utime=self._after_utime)
        return HistoryRequest(number, self.next, last, known=self.reached, asks_known=self.asks_known)

    def is_of_this_run(self, request: HistoryRequest, answer: HistoryAnswer, newest: int) -> bool:
        """Return whether an answer can be of this run, and leave out what it shows to be damaged.

        ``newest`` is the largest number that the gateway has published.
        """
        numbered = [(sequence_of(message), message) for message in answer.messages]
        has_same = any(self.arrived.held.get(number) == message for number, message in numbered)
        if has_same or request.is_confirmed_by(answer):
            self.leave_out_beyond(newest)
            return True
        return not self.arrived.is_older_than(numbered, newest)

    # False numbers.

    def leave_out_beyond(self, newest: int) -> None:
        """Leave out what has arrived with numbers that the gateway has not published."""
        arrived = self.arrived
        if arrived.until <= newest:
            return
        for number in [number for number in arrived.held if number > newest]:
            arrived.release(number)
            self.num_damaged += 1
        arrived.until = newest
        # Otherwise, the next genuine message would have a smaller number than the newest: a restart, again.
        if arrived.newest > newest and self.reached is not None:
            arrived.newest, arrived.newest_utime = self.reached

    def correct_known(self, number: int) -> None:
        """Take this as the number of the known message, which came with a false one."""
        if self.reached is not None:
            false_number, utime = self.reached
            # If it is a copy of an earlier message, those after that one were handed on before the copy.
            while number + 1 != false_number and self.recent.has(number + 1):
                number += 1
            self.check.correct(number)
            self.reached, self.next = (number, self.recent.utime_of(number, utime)), number + 1
        self.arrived.newest = number
