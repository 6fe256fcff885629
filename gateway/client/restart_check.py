"""Whether a gateway has restarted: the question, what arrives meanwhile, and what an answer shows.

The numbers of what arrives cannot decide this. They go back after a restart; but one message with a false
number, damaged or of another program, looks the same: the next genuine one has a smaller number. A subscriber
that took this for a restart would hand on the last minute as if it were live. And the numbers of a new run
may be larger than those of the last one, if much of it was missed. So the history decides, by the last known
message.
"""

import enum
from typing import Final

from gateway.client.arrived_run import ArrivedRun, HeldBytes
from gateway.client.delivery import Delivery
from gateway.client.history_requests import HistoryAnswer, HistoryRequest
from gateway.messages.history import sequence_of, utime_of

_MAX_RUNS: Final = 1000
"""How many restarts in a row may wait to be checked: the numbers come from the network."""


class Verdict(enum.Enum):
    """What an answer of the history shows."""

    ASK_AGAIN = enum.auto()
    """Nothing: a part of the answer was lost."""
    ASK_FOR_TIME = enum.auto()
    """It does not have the number of the known message. Its time is to be asked for, at once."""
    SAME_RUN = enum.auto()
    """The gateway has the known message, so it has not restarted."""
    FALSE_NUMBER = enum.auto()
    """The gateway has not restarted; it has the known message with another number."""
    RESTARTED = enum.auto()
    """It no longer has the known message."""


class RestartCheck:
    """Asks whether the gateway has restarted: by the number of the last known message, then by its time.

    ``later_runs`` is what has arrived since the numbers went back; one more each time that they did so again.
    """

    def __init__(self, held_bytes: HeldBytes) -> None:
        self.later_runs: list[ArrivedRun] = []
        self._held_bytes = held_bytes
        self._asks_for_time = False

    @property
    def has_too_many_runs(self) -> bool:
        """Whether the numbers go back so often that they say nothing."""
        return len(self.later_runs) > _MAX_RUNS

    def begin(self, *, asks_for_time: bool = False) -> None:
        """Begin with the first question, or with the second one."""
        self._asks_for_time = asks_for_time

    def add_run(self) -> None:
        """Note that the numbers of what arrives have gone back."""
        self.later_runs.append(ArrivedRun(self._held_bytes))

    def take_runs(self) -> list[ArrivedRun]:
        """Return what has arrived since the numbers went back, and forget it."""
        taken, self.later_runs = self.later_runs, []
        return taken

    def request(self, number: int, delivery: Delivery) -> HistoryRequest:
        """Return the question, as the request with this number."""
        known = delivery.known
        if self._asks_for_time:
            return HistoryRequest(number, since_utime=known[1], known=known)
        return HistoryRequest(number, known[0], known[0], known=known, asks_known=True)

    def judge(
        self, request: HistoryRequest, answer: HistoryAnswer, delivery: Delivery, newest: int
    ) -> Verdict:
        """Return what the answer to a question shows; ``newest`` is the largest number of the gateway."""
        if not self._asks_for_time and request.is_confirmed_by(answer):
            return Verdict.SAME_RUN
        if not answer.is_whole:
            return Verdict.ASK_AGAIN
        if not self._asks_for_time:
            # The known number may be the false one. A restart does not change when a message was published.
            self._asks_for_time = True
            return Verdict.ASK_FOR_TIME
        assert request.known is not None  # noqa: S101 - it is what was asked
        utime = request.known[1]
        first = answer.messages[0] if answer.messages else None
        if first is not None and utime_of(first) == utime:
            return Verdict.FALSE_NUMBER
        # After a long outage, the known message may be too old for the history, although the run goes on. All
        # numbers must fit: a wrong guess would join two runs, and hide what is missing between them.
        if self._is_consistent(request.known, answer, delivery, newest):
            return Verdict.SAME_RUN
        return Verdict.RESTARTED

    def _is_consistent(
        self, known: tuple[int, int], answer: HistoryAnswer, delivery: Delivery, newest: int
    ) -> bool:
        """Whether an answer without the known message can be of its run: later ones have larger numbers."""
        number, utime = known
        if not answer.messages or sequence_of(answer.messages[0]) <= number:
            return False
        numbered = [(sequence_of(message), message) for message in answer.messages]
        if delivery.arrived.is_older_than(numbered, newest):
            return False
        return not any(
            later.newest <= number or later.goes_back_before(number, utime) for later in self.later_runs
        )

    # What follows from the verdict.

    def rejoin(self, delivery: Delivery, newest: int) -> None:
        """Put what has arrived back into the one run that there is."""
        delivery.leave_out_beyond(newest)
        arrived = delivery.arrived
        for later in self.take_runs():
            # The numbers went back because a message before had a false one, and it may still be held.
            arrived.let_go_between(later.first, later.newest_utime)
            if later.until <= newest:
                arrived.until = max(arrived.until, later.until)
            for number in sorted(later.held):
                message = later.release(number)
                if delivery.next <= number <= newest:
                    arrived.hold(number, message)
                    arrived.note(number, utime_of(message), arrived.newest_session)
                else:
                    delivery.num_damaged += 1

    def take_new_run(
        self, delivery: Delivery, answer: HistoryAnswer | None, *, is_held_before: bool
    ) -> ArrivedRun:
        """Return what has arrived of the gateway that has restarted, and keep the runs between.

        ``answer`` is what that gateway has answered, if anything. If ``is_held_before``, its numbers are past
        those that are held of a run before it.
        """
        utimes = [] if answer is None else [utime_of(message) for message in answer.messages]
        former = delivery.arrived
        if self.later_runs:
            new = self.later_runs.pop()
        elif is_held_before and utime_of(former.held[former.first]) >= min(utimes):
            # The clock was set back at the restart, so times do not tell the two runs apart. All that is held
            # is of the former one: what arrives of the new one would have been a later run.
            new = ArrivedRun(self._held_bytes)
        elif utimes:
            # Nothing went back: the new numbers are past the old ones, or nothing of the new run has arrived.
            new = former.split(lambda utime: utime >= min(utimes))
            # Larger numbers than those that have arrived may be of the new run, too: nobody knows how many
            # the former one had.
            former.until = min(former.until, max([former.newest, *former.held]))
        elif delivery.reached is None:
            new = ArrivedRun(self._held_bytes)  # all that has arrived is of the run that has ended
        else:
            known_utime = delivery.known[1]
            new = former.split(lambda utime: utime < known_utime)
        if answer is not None and not new.held:
            new.until = max(new.until, answer.newest)
        return new

    def time_before(self, delivery: Delivery, new: ArrivedRun, answer: HistoryAnswer | None) -> int | None:
        """Return after which time to request the first messages of a new run; None to do so by number."""
        if answer is None or not answer.messages:
            return None
        runs = (delivery.arrived, *self.later_runs)
        held = [utime_of(message) for each in runs for message in each.held.values()]
        reached_utime = max(held, default=0) if delivery.reached is None else delivery.reached[1]
        later = [utime_of(message) for message in answer.messages]
        if new.newest >= 0:
            later.append(new.newest_utime)
        # If the clock was set back, a request by time would leave out the beginning of the new run.
        if min(later) <= reached_utime:
            return None
        return max([reached_utime, *held]) + 1
