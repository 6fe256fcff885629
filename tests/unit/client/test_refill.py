"""The threads that request what is missing, with a reception and a gateway of the test."""

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from gateway.client.completion_states import Unknown
from gateway.client.history_requests import COMPLETE, Completeness, HistoryAnswer, HistoryRequest
from gateway.client.refill import END_S, KeptSeries, Refill
from gateway.client.request_timing import NOBODY_S, PATIENCE_S
from gateway.errors import QueryError
from gateway.messages.encode import PREFIX
from gateway.messages.sequence_check import SequenceCheck
from tests.support.clocks import Clock
from tests.support.waiting import wait_until


def message(sequence: int) -> bytes:
    return bytes(8) + PREFIX.pack(1000 + sequence, 0, sequence, 1, 0)


class Source:
    """The source of a subscriber, of which something has arrived just now, or at another time."""

    heard_s: float | None = None
    found_s = 0.0
    first_utime = 1000


class Series:
    """The series of a subscriber that the refill needs to know."""

    key = "status"

    def __init__(self, source: Source) -> None:
        self.source = source
        self.check = SequenceCheck()


class Subscriber:
    """A subscriber to ``num_series`` of one source. Answers have ``answer_size`` messages."""

    def __init__(
        self, num_series: int, answer_size: int, monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        self.lock = threading.Lock()
        self.num_looks = 0
        self.rooms: Sequence[bool] = ()
        """What the first looks for room find; later ones find some."""
        self.asked: list[Series] = []
        self.handed_on: list[int] = []
        self.source: Any = Source()
        self.series: Any = [Series(self.source) for _ in range(num_series)]
        self._answer_size = answer_size
        self.answers: threading.Semaphore | None = None
        """How many more requests are answered; None for all."""
        self.refill = Refill(self, self.lock, self._ask, lambda *_: [], COMPLETE, monotonic)
        self.completions = [self.refill.add(each, self._hand_on) for each in self.series]

    @property
    def has_room(self) -> bool:
        self.num_looks += 1
        return self.num_looks > len(self.rooms) or self.rooms[self.num_looks - 1]

    def failed(self, defect: Exception) -> None:
        pytest.fail(repr(defect))

    def _hand_on(self, message: bytes) -> None:
        self.handed_on.append(PREFIX.unpack_from(message, 8)[2])

    def _ask(self, series: Series, request: HistoryRequest, _timeout_s: float) -> HistoryAnswer:
        self.asked.append(series)
        if self.answers is not None and not self.answers.acquire(timeout=60):
            raise QueryError("no answer", code="timeout")
        first = int(request.options["from"])
        last = min(first + self._answer_size - 1, int(request.options.get("to", 99)))
        return HistoryAnswer([message(number) for number in range(first, last + 1)], first, last, 99)

    def arrives(self, number: int) -> None:
        """A message of each series arrives. The caller holds the lock."""
        for series, completion in zip(self.series, self.completions, strict=True):
            completion.receive(message(number), number, 1000 + number, 1, 0.0)
            if completion.due_s < math.inf:
                self.refill.check(series)


def test_no_series_is_refilled_far_ahead_of_the_others() -> None:
    """Otherwise, the others would be too old for the history by the time that it is their turn."""
    subscriber = Subscriber(2, answer_size=10)
    with subscriber.lock:
        subscriber.arrives(0)
        subscriber.arrives(60)
    wait_until(lambda: subscriber.refill.num_incomplete == 0)
    subscriber.refill.close()
    assert sorted(subscriber.handed_on) == sorted([*range(61)] * 2)
    turns = [subscriber.asked.count(series) for series in subscriber.series]
    assert turns[0] == turns[1] > 5
    for number in range(0, len(subscriber.asked), 2):
        assert set(subscriber.asked[number : number + 2]) == set(subscriber.series)


def test_nothing_is_requested_while_the_program_has_no_room_for_it() -> None:
    """What the history brings would push out what the program has not read yet."""
    subscriber = Subscriber(1, answer_size=100)
    subscriber.rooms = (False, False, False)
    with subscriber.lock:
        subscriber.arrives(0)
        subscriber.arrives(9)
    wait_until(lambda: subscriber.asked)
    assert subscriber.num_looks > len(subscriber.rooms)
    subscriber.refill.close()


def test_a_series_that_has_got_what_was_late_delays_nothing() -> None:
    """Until the thread has seen it, the series is still among those to look at."""
    subscriber = Subscriber(1, answer_size=100)
    with subscriber.lock:
        subscriber.arrives(0)
        subscriber.arrives(2)
        assert subscriber.refill.reached_utime(subscriber.source) == 1000
        subscriber.arrives(1)
        assert subscriber.refill.reached_utime(subscriber.source) == math.inf
    subscriber.refill.close()


@pytest.mark.parametrize(
    ("code", "until_s"),
    [("timeout", PATIENCE_S), ("busy", PATIENCE_S), ("no-gateway", NOBODY_S), ("disabled", 0.0)],
)
def test_how_long_a_gateway_is_asked_which_series_are_silent(code: str, until_s: float) -> None:
    """Not for ever: the gateway may be one of an earlier version, and have no history."""
    now_s = 100.0

    def find(*_: Any) -> list[KeptSeries]:
        raise QueryError("", code=code)

    refill = Refill(
        *(Subscriber(0, 0), threading.Lock(), None, find),  # type: ignore[arg-type] # not used
        completeness=Completeness(last_s=10.0, patience_s=1.0),
        monotonic=lambda: now_s,
    )
    source: Any = Source()
    while (again_s := refill._begin_silent(source, 100.0)) < math.inf:
        assert again_s > now_s
        now_s = again_s
    assert now_s == pytest.approx(100.0 + until_s, abs=0.2)


@pytest.mark.parametrize("num_answers", [0, 5, 11])
def test_the_end_waits_as_long_as_messages_come(num_answers: int) -> None:
    """A busy computer may need a minute for all of a key; of a gateway that has ended, nothing comes."""
    clock = Clock()
    subscriber = Subscriber(1, answer_size=10, monotonic=clock)  # the known message, and nine
    subscriber.answers = answers = threading.Semaphore(0)
    with subscriber.lock:
        subscriber.arrives(0)
    subscriber.refill.end()
    answered_s = clock()

    def tick() -> None:
        """Give one answer, and wait until it is there: each takes most of the patience."""
        nonlocal answered_s
        num_handed_on = len(subscriber.handed_on)
        if num_handed_on == 100:
            return  # whatever else ends now takes no time
        clock.now_s += 0.7 * END_S
        if num_handed_on <= 9 * num_answers:
            answers.release()
            wait_until(lambda: len(subscriber.handed_on) > num_handed_on)
            answered_s = clock()

    subscriber.refill.wait_for_end(0.0, tick)
    assert subscriber.handed_on == [*range(1 + 9 * num_answers)]
    assert (subscriber.refill.num_incomplete == 0) == (num_answers == 11)
    assert num_answers == 11 or END_S <= clock() - answered_s <= 1.5 * END_S
    subscriber.refill.close()
    answers.release()


def test_what_nothing_shows_is_looked_for_when_a_source_is_heard_again() -> None:
    """All of a key may have been published in an outage, and the numbers of the others go on by chance."""
    clock = Clock()
    subscriber = Subscriber(1, answer_size=100, monotonic=clock)
    subscriber.refill._find = lambda *_: [KeptSeries(subscriber.series[0], 50, 1050)]
    with subscriber.lock:
        subscriber.arrives(0)
        subscriber.refill.look_after_silence(subscriber.source)

    def has_come() -> bool:
        clock.now_s += 0.1
        return len(subscriber.handed_on) == 51

    wait_until(has_come)
    subscriber.refill.close()


def test_the_end_comes_though_a_gateway_goes_on_publishing() -> None:
    clock = Clock()
    subscriber = Subscriber(1, answer_size=100, monotonic=clock)
    num_looks = 0

    def find(*_: Any) -> list[KeptSeries]:
        nonlocal num_looks
        num_looks += 1
        newest = 99 + num_looks
        return [KeptSeries(subscriber.series[0], newest, 1000 + newest)]

    subscriber.refill._find = find
    with subscriber.lock:
        subscriber.arrives(0)

    def is_complete() -> bool:
        clock.now_s += 0.1
        return subscriber.refill.num_incomplete == 0

    subscriber.refill.end()
    wait_until(is_complete)
    subscriber.refill.close()
    assert num_looks == 1


def test_at_the_end_a_gateway_that_has_no_status_yet_has_been_started_again() -> None:
    """It publishes one every second. Of events, it may have kept none."""
    for key, unknown in (("status", Counter({Unknown.RESTART: 1})), ("event", Counter[Unknown]())):
        subscriber = Subscriber(1, answer_size=100)
        subscriber.series[0].key = key
        completion = subscriber.refill.add(subscriber.series[0], lambda _: None)
        with subscriber.lock:
            completion.receive(message(0), 0, 1000, 1, 0.0)
            completion.end(1.0)
            completion.fail(completion.request(), "nothing-yet", "", 1.0)
        subscriber.refill.close()
        assert +completion.unknown == unknown
