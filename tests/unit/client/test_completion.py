"""Filling gaps from the gateway's history, against a model of the gateway and of the network between."""

import itertools
import math
from typing import Final

import pytest
from hypothesis import given, note, settings
from hypothesis import strategies as st

from gateway.client.arrived_run import HeldBytes
from gateway.client.completion import PASSING_S, Completion
from gateway.client.completion_states import Unknown
from gateway.client.history_requests import COMPLETE, Completeness, HistoryAnswer, HistoryRequest
from gateway.client.publisher_watch import TWO_GATEWAYS_S
from gateway.client.request_timing import GRACE_S, NOBODY_S, PATIENCE_S
from gateway.messages.encode import PREFIX
from gateway.messages.history import utime_of
from gateway.messages.sequence_check import SequenceCheck
from tests.support.examples import examples

SIZE: Final = len(bytes(8) + PREFIX.pack(0, 0, 0, 0, 0))
ENTRY: Final = SIZE + 128
"""What a held message takes."""


class Network:
    """A gateway with the newest ``window`` messages, and the Completion of a subscriber.

    ``handed_on`` has the run of the gateway and the number of each message.
    """

    def __init__(
        self, window: int = 10**9, limit: int = 10**9, completeness: Completeness = COMPLETE
    ) -> None:
        self.room = HeldBytes(limit)
        self.check = SequenceCheck(counts_first=True, max_listed=100)
        self.completion = Completion(self._hand_on, self.check, self.room, completeness)
        self.handed_on: list[tuple[int, int]] = []
        self.history: list[bytes] = []
        self.published: list[tuple[int, int]] = []
        self.run = 0
        self.now_s = 100.0
        self._window = window
        self.newest = 0
        """The largest number of this run that has arrived."""
        self._number = 0
        self._utime = 0
        self._runs: dict[int, int] = {}  # by utime

    def _hand_on(self, message: bytes) -> None:
        utime, _, number, session, _ = PREFIX.unpack_from(message, 8)
        self.check.add(number, utime, session)
        self.handed_on.append((self._runs[utime], number))

    def publish(self) -> bytes:
        self._utime += 1
        self._runs[self._utime] = self.run
        message = bytes(8) + PREFIX.pack(self._utime, 0, self._number, 1, 0)
        self.published.append((self.run, self._number))
        self._number += 1
        self.history = [*self.history, message][-self._window :]
        return message

    def publish_other(self, number: int) -> bytes:
        """Return a message of another program, with the same key; its run is -1."""
        self._utime += 1
        self._runs[self._utime] = -1
        return bytes(8) + PREFIX.pack(self._utime, 0, number, 1, 0)

    def arrive(self, *messages: bytes) -> None:
        for message in messages:
            utime, _, number, session, _ = PREFIX.unpack_from(message, 8)
            self.newest = max(self.newest, number)
            self.completion.receive(message, number, utime, session, self.now_s)

    def arrives(self, number: int) -> None:
        """Publish up to a number, of which only the last one arrives."""
        while self._number < number:
            self.publish()
        self.arrive(self.publish())

    def restart(self) -> None:
        self.run += 1
        self._number = self.newest = 0
        self.history = []

    def find(self, request: HistoryRequest, max_messages: int = 10**9) -> HistoryAnswer | None:
        """Answer as a gateway does; None if it has nothing."""
        if not self.history:
            return None
        options = request.options
        numbers = [PREFIX.unpack_from(message, 8)[2] for message in self.history]
        if "since_utime" in options:
            since_utime = int(options["since_utime"])
            times = [
                (number, utime_of(message)) for number, message in zip(numbers, self.history, strict=True)
            ]
            first = next((number for number, utime in times if utime >= since_utime), numbers[-1] + 1)
        else:
            first = int(options["from"]) if "from" in options else max(numbers[0], numbers[-1] - 5)
        last = min(int(options.get("to", numbers[-1])), numbers[-1])
        found = [
            (number, message)
            for number, message in zip(numbers, self.history, strict=True)
            if first <= number <= last
        ]
        if len(found) > max_messages:
            last = found[max_messages - 1][0]
        messages = [message for _, message in found[:max_messages]]
        return HistoryAnswer(messages, first, last, numbers[-1])

    def ask(self, max_messages: int = 10**9) -> None:
        """Request what is due, and answer."""
        self.now_s = max(self.now_s, self.completion.due_s)
        request = self.completion.request()
        answer = self.find(request, max_messages)
        if answer is None:
            self.completion.fail(request, "nothing-yet", "", self.now_s)
        else:
            self.completion.answer(request, answer, self.now_s)

    def ask_all(self) -> None:
        for _ in range(10_000):
            if self.completion.due_s == math.inf:
                return
            self.ask(3)
        pytest.fail("it never ends")

    @property
    def numbers(self) -> list[int]:
        return [number for _, number in self.handed_on]


EVENTS: Final = st.sampled_from(
    ["arrives"] * 6 + ["lost"] * 3 + ["many lost", "late", "twice", "late ones arrive", "ask", "ask", "busy"]
    + ["partly lost", "begin to ask", "answer", "restart", "pass by"]
)  # fmt: skip


@settings(max_examples=examples(400), deadline=None)
@given(
    st.lists(EVENTS, max_size=60),
    st.sampled_from([10**9, 10**9, 4, 15]),
    st.sampled_from([10**9, 5 * ENTRY]),
    st.sampled_from([None, 1.0]),
)
def test_everything_that_still_exists_comes_once_and_in_order(  # noqa: C901, PLR0912, PLR0915 - one model
    events: list[str], window: int, limit: int, last_s: float | None
) -> None:
    """Whatever the network does: the numbers of each run grow, and what is missing is counted."""
    network = Network(window, limit, Completeness(is_complete=True, last_s=last_s))
    late: list[bytes] = []
    came_late: set[tuple[int, int]] = set()
    asked: tuple[HistoryRequest, HistoryAnswer | None] | None = None
    on_time: set[tuple[int, int]] = set()
    completion = network.completion
    if last_s is not None:
        network.arrives(9)
        network.arrives(12)
        network.ask(7)
    for event in [*events, "late ones arrive", "arrives"]:
        network.now_s += 0.02
        is_due = completion.due_s <= network.now_s
        match event:
            case "arrives" | "twice":
                message = network.publish()
                on_time.add(network.published[-1])
                network.arrive(*[message] * (1 + (event == "twice")))
            case "lost":
                network.publish()
            case "many lost":
                for _ in range(20):
                    network.publish()
            case "late":
                late.append(network.publish())
                came_late.add(network.published[-1])
            case "late ones arrive":
                network.arrive(*reversed(late))
                late = []
            case "restart" | "pass by":
                network.arrive(*late)
                late = []
                # A restart shows if the numbers go back, or if something is missing.
                num_lost = len(network.published) + 3 if event == "pass by" else min(3, network.newest)
                network.restart()
                for _ in range(num_lost):
                    network.publish()
                if event == "restart":
                    network.arrive(network.publish())
            case "ask" if is_due:
                network.ask(7)
            case "busy" if is_due:
                completion.fail(completion.request(), "busy", "", network.now_s)
            case "partly lost" if is_due:
                request = completion.request()
                answer = network.find(request, 7)
                if answer is not None:
                    part = answer._replace(messages=answer.messages[1::2], is_whole=len(answer.messages) == 0)
                    completion.answer(request, part, network.now_s)
            case "begin to ask" if is_due:
                request = completion.request()
                asked = request, network.find(request, 7)
            case "answer" if asked is not None and asked[1] is not None:
                completion.answer(*asked, network.now_s)  # type: ignore[arg-type]
                asked = None
        assert network.room.used <= limit + ENTRY
    network.ask_all()
    assert network.room.used == 0
    handed_on = network.handed_on
    note(f"published {network.published}, handed on {handed_on}")
    assert handed_on == sorted(set(handed_on))
    assert not completion.problem
    if limit > 10 * ENTRY:
        first = handed_on[0]
        assert {each for each in on_time - came_late if each >= first} <= set(handed_on)
    if window > 100:
        run, number = handed_on[0]
        expected = [
            each
            for each in network.published
            if each[0] == network.run and (each[0] > run or each[1] >= number)
        ]
        assert [each for each in handed_on if each[0] == network.run] == expected
    last = [number for run, number in handed_on if run == network.run]
    assert last[-1] == network.published[-1][1]


def test_a_late_message_is_not_requested() -> None:
    """LCM may deliver in another order; a request for each such message would cost more than the messages."""
    network = Network()
    first, late, newer = (network.publish() for _ in range(3))
    network.arrive(first, newer)
    assert network.completion.due_s == network.now_s + GRACE_S
    assert network.numbers == [0]
    network.arrive(late)
    assert network.completion.due_s == math.inf
    assert network.numbers == [0, 1, 2]
    assert network.completion.num_refilled == 0


def test_what_exists_no_more_is_named() -> None:
    """The numbers tell a colleague which frames of the take to look for elsewhere."""
    network = Network(window=5)
    network.arrives(0)
    network.arrives(20)
    network.ask_all()
    assert network.numbers == [0, *range(16, 21)]
    assert network.completion.num_refilled == 4
    [gap] = network.check.gaps
    assert (gap.stop - gap.missing, gap.stop) == (1, 16)


def test_one_request_shows_that_nothing_of_a_gap_exists_any_more() -> None:
    network = Network(window=1)
    network.arrives(0)
    network.arrives(20)
    network.ask()
    assert network.numbers == [0, 20]
    assert network.completion.due_s == math.inf


def test_a_gap_ends_although_what_came_after_it_exists_no_more_either() -> None:
    """An answer without any message settles it; otherwise, what has arrived would wait for a minute."""
    network = Network(window=3)
    network.arrives(0)
    for number in range(5, 10):
        network.arrives(number)
    network.ask()
    assert network.numbers == [0, *range(5, 10)]
    assert network.check.num_lost == 4
    assert network.completion.due_s == math.inf


def test_messages_so_long_that_an_answer_has_only_one_are_refilled() -> None:
    """The message that shows that the gateway has not restarted must not take the place of all others."""
    network = Network()
    network.arrives(0)
    network.arrives(5)
    start_s = network.completion.due_s
    while network.completion.due_s < math.inf:
        network.ask(1)
    assert network.numbers == [*range(6)]
    assert network.now_s == start_s


def test_a_restart_after_which_the_clock_was_set_back_is_one() -> None:
    """Otherwise, its messages would be left out as late until the numbers are past those before."""
    network = Network()
    network.arrives(5000)
    network.restart()
    network._utime = -1000
    network.arrives(0)
    network.ask_all()
    assert network.handed_on == [(0, 5000), (1, 0)]


@pytest.mark.parametrize(
    ("code", "patience_s"), [("timeout", PATIENCE_S), ("busy", PATIENCE_S), ("no-gateway", NOBODY_S)]
)
def test_requests_that_bring_nothing_are_repeated_for_a_bounded_time(code: str, patience_s: float) -> None:
    """Zenoh needs a while to connect again; a program must not wait forever for an earlier version."""
    network = Network()
    network.arrives(0)
    network.arrives(9)
    start_s = network.completion.due_s
    number = 9
    while network.completion.due_s < math.inf:
        network.now_s = network.completion.due_s
        network.completion.fail(network.completion.request(), code, "", network.now_s)
        number += 1
        network.arrives(number)
    assert network.now_s == pytest.approx(start_s + patience_s, abs=0.2)
    assert network.numbers == [0, *range(9, number + 1)]
    assert network.check.num_lost == 8
    # The next gap: nobody was there the last time, so one request is enough until there is an answer.
    network.arrives(number + 10)
    network.now_s = network.completion.due_s
    network.completion.fail(network.completion.request(), code, "", network.now_s)
    assert (network.completion.due_s == math.inf) == (code == "no-gateway")


def test_requests_without_a_connection_do_not_end_soon() -> None:
    """A router that is restarted again and again takes no requests for longer than NOBODY_S."""
    network = Network()
    network.arrives(0)
    network.arrives(9)
    start_s = network.now_s
    while network.now_s < start_s + 2 * NOBODY_S:
        network.now_s = network.completion.due_s
        network.completion.fail(
            *(network.completion.request(), "no-gateway", "", network.now_s), is_connected=False
        )
    assert network.completion.due_s < math.inf
    assert network.numbers == [0]


def test_a_restart_that_a_message_shows_holds_up_nothing_for_long_if_nobody_takes_requests() -> None:
    """That message has shown a connection: the gateway may be one of an earlier version."""
    network = Network()
    network.arrives(3)
    network.restart()
    network.arrives(0)
    start_s = network.now_s
    while network.completion.due_s < math.inf:
        network.now_s = network.completion.due_s
        network.completion.fail(
            *(network.completion.request(), "no-gateway", "", network.now_s), is_connected=False
        )
    assert network.handed_on == [(0, 3), (1, 0)]
    assert network.now_s - start_s < 2 * NOBODY_S


def test_patience_begins_again_after_a_time_without_connection() -> None:
    """While nothing arrives, no request can be answered: that says nothing about the history."""
    network = Network()
    network.arrives(0)
    network.arrives(9)
    for _ in range(2):
        network.now_s += 0.7 * PATIENCE_S
        network.completion.fail(network.completion.request(), "timeout", "", network.now_s)
        network.arrive(network.publish())
    network.ask_all()
    assert network.numbers == [*range(12)]


def test_a_gateway_that_keeps_nothing_delays_nothing_until_it_restarts() -> None:
    network = Network()
    network.arrives(0)
    network.arrives(9)
    network.completion.fail(network.completion.request(), "disabled", "not kept", network.now_s)
    network.arrives(12)
    assert network.numbers == [0, 9, 12]
    assert network.completion.problem == "not kept"
    assert network.completion.due_s == math.inf
    network.restart()
    network.arrives(2)
    network.ask_all()
    assert network.handed_on[3:] == [(1, 0), (1, 1), (1, 2)]
    assert not network.completion.problem


def test_of_two_gateways_everything_is_passed_on() -> None:
    """Their numbers do not say what is missing: requests would never end."""
    network, other = Network(), Network()
    other._number, other._utime = 5000, 10**6
    other.completion = network.completion
    network._runs = other._runs
    for _ in range(20):
        network._utime = other._utime
        network.arrive(network.publish())
        other._utime = network._utime
        other.arrive(other.publish())
    assert network.completion.problem
    assert network.completion.due_s == math.inf
    assert sorted(network.numbers) == [*range(20), *range(5000, 5020)]
    assert network.room.used == 0


def test_when_a_second_gateway_has_ended_gaps_are_filled_again() -> None:
    """One that published for a second must not cost what is missed an hour later."""
    network, other = Network(), Network()
    other._number, other._utime = 5000, 10**6
    other.completion, network._runs = network.completion, other._runs
    for _ in range(20):
        network._utime = other._utime
        network.arrive(network.publish())
        other._utime = network._utime
        other.arrive(other.publish())
    assert network.completion.problem
    network._utime = other._utime
    network.arrive(network.publish())
    network.now_s += TWO_GATEWAYS_S
    network.arrive(network.publish())
    assert not network.completion.problem
    network.arrives(30)
    network.ask_all()
    assert network.numbers[-11:] == [*range(20, 31)]
    assert network.completion.unknown[Unknown.TWO_GATEWAYS] == 1


def test_copies_that_come_long_after_are_no_second_gateway() -> None:
    """A network of two paths delivers each message twice, the second time up to a second later."""
    network = Network()
    messages = [network.publish() for _ in range(60)]
    for number, message in enumerate(messages):
        network.arrive(message)
        if number >= 40:
            network.arrive(messages[number - 40])
    network.ask_all()
    assert network.numbers == [*range(60)]
    assert not network.completion.last_problem


@pytest.mark.parametrize("code", ["refused", "unreadable", "defect", "disabled"])
def test_a_refusal_is_over_after_a_while(code: str) -> None:
    """One garbled answer must not switch refilling off until the subscriber is started again."""
    network = Network()
    network.arrives(0)
    network.arrives(9)
    network.completion.fail(network.completion.request(), code, "no", network.now_s)
    network.arrives(11)
    assert network.numbers == [0, 9, 11]
    network.now_s += PASSING_S
    network.arrives(20)
    network.ask_all()
    assert network.numbers == [0, 9, 11, *range(12, 21)]
    assert network.completion.last_problem == "no"


def test_after_a_refusal_a_gap_is_requested_by_its_numbers() -> None:
    """From the restart on, which was found before, an answer has the oldest messages, and never the gap."""
    network = Network()
    network.arrives(5)
    network.restart()
    network.arrives(9)
    while network.completion.request().known is not None:  # until the restart is known
        network.ask()
    network.completion.fail(network.completion.request(), "refused", "no", network.now_s)
    network.arrives(20)
    network.now_s += PASSING_S
    network.arrives(30)
    network.ask(3)
    network.ask(3)
    assert network.numbers == [5, 9, *range(20, 25)]


def test_what_came_before_the_first_message_that_arrives_is_requested() -> None:
    """The first event of a source may fall into an outage; the second one shows that there was one."""
    network = Network()
    messages = [network.publish() for _ in range(3)]
    network.completion.begin_since(1, network.now_s)
    network.arrive(messages[2])
    network.ask_all()
    assert network.numbers == [0, 1, 2]
    assert not network.completion.unknown.total()


def test_a_key_that_began_late_does_not_give_up_soon_without_a_connection() -> None:
    """A router that is started again and again takes no requests for longer than NOBODY_S."""
    network = Network()
    messages = [network.publish() for _ in range(3)]
    network.completion.begin_since(1, network.now_s)
    network.arrive(messages[2])
    network.ask_all()
    network.arrives(9)
    start_s = network.now_s
    while network.now_s < start_s + 2 * NOBODY_S:
        network.now_s = network.completion.due_s
        network.completion.fail(
            *(network.completion.request(), "no-gateway", "", network.now_s), is_connected=False
        )
    assert network.numbers == [0, 1, 2]
    network.ask_all()
    assert network.numbers == [*range(10)]


def test_what_came_before_the_first_message_is_unknown_if_nobody_says_it() -> None:
    network = Network()
    messages = [network.publish() for _ in range(3)]
    network.completion.begin_since(1, network.now_s)
    network.arrive(messages[2])
    end_s = network.now_s + 2 * PATIENCE_S
    while network.completion.due_s < end_s:
        network.now_s = network.completion.due_s
        network.completion.fail(network.completion.request(), "timeout", "", network.now_s)
    assert network.numbers == [2]
    assert network.completion.unknown[Unknown.BEGINNING] == 1


@pytest.mark.parametrize(("has_restarted", "num_published"), [(False, 3), (True, 3), (True, 4)])
def test_the_last_messages_before_a_pause_are_requested_when_the_history_is_looked_up(
    has_restarted: bool, num_published: int
) -> None:
    """Nothing later arrives that would show them: the end of a trial in an outage, or a whole second one."""
    network = Network()
    network.arrives(3)
    if has_restarted:
        network.restart()
    newest = [network.publish() for _ in range(num_published)][-1]  # of four, the number that has arrived
    _, _, number, _, _ = PREFIX.unpack_from(newest, 8)
    network.completion.notice(number, network._utime, network.now_s)
    network.ask_all()
    expected = [(1, number) for number in range(num_published)] if has_restarted else [(0, 4), (0, 5), (0, 6)]
    assert network.handed_on == [(0, 3), *expected]
    assert network.completion.unknown[Unknown.RESTART] == has_restarted


def test_what_is_held_does_not_wait_for_a_gateway_that_has_restarted() -> None:
    """Its history will never have what was missing before: 60 s for each gap would be in vain."""
    network = Network()
    network.arrives(0)
    network.arrives(9)
    network.arrives(12)
    start_s = network.now_s
    network.restart()
    network.publish()
    while len(network.handed_on) < 4:
        network.ask()
        assert network.now_s < start_s + 1.0
    assert network.handed_on == [(0, 0), (0, 9), (0, 12), (1, 0)]
    assert network.check.num_lost == 8 + 2


def test_messages_of_a_restarted_gateway_without_room_come_once() -> None:
    """What is let go of two runs must not be taken for each other."""
    network = Network()
    network.arrives(3)
    for _ in range(2):
        for _ in range(3):
            message = network.publish()
            utime, _, number, session, _ = PREFIX.unpack_from(message, 8)
            network.completion.receive(message, number, utime, session, network.now_s, has_room=False)
        network.restart()
    network.publish()
    network.arrive(network.publish())
    network.ask_all()
    assert network.handed_on == [(0, 3), (2, 0), (2, 1)]
    assert network.check.num_lost == 3 + 3
    assert network.completion.unknown[Unknown.RESTART] == 2


def test_a_restart_is_found_although_the_new_numbers_in_the_history_are_past_the_known_one() -> None:
    """Otherwise, the first message of the new run would be left out, and no restart reported."""
    network = Network(window=5)
    network.arrives(5)
    network.restart()
    network.arrives(0)
    for _ in range(20):
        network.publish()
    network.ask_all()
    network.arrives(21)
    network.ask_all()
    assert network.handed_on == [(0, 5), (1, 0), *((1, number) for number in range(17, 22))]
    assert network.completion.unknown[Unknown.RESTART] == 1
    assert network.completion.num_damaged == 0


def test_a_restart_is_found_although_no_message_has_arrived_since() -> None:
    """What is held is of the former run: as one of the new run, it contradicts each answer, endlessly."""
    network = Network(window=5)
    network.arrives(5)
    network.arrives(9)
    network.restart()
    for _ in range(11):
        network.publish()
    network.ask_all()
    assert network.handed_on == [(0, 5), (0, 9), *((1, number) for number in range(6, 11))]
    assert network.completion.unknown[Unknown.RESTART] == 1


def test_a_message_of_another_program_with_the_next_number_repeats_nothing() -> None:
    """The history does not know it, which looks like a restart; a robot would repeat the last minute."""
    network = Network()
    network.arrive(*(network.publish() for _ in range(5)))
    network.arrive(network.publish_other(5))
    network.arrive(*(network.publish() for _ in range(3)))
    network.ask_all()
    assert network.handed_on == [*((0, number) for number in range(5)), (-1, 5), (0, 5), (0, 6), (0, 7)]
    assert network.completion.unknown[Unknown.RESTART] == 1


def test_what_is_held_comes_once_although_another_program_makes_the_numbers_go_back() -> None:
    """What was held is handed on at the seeming restart, so the history is asked for what is later."""
    network = Network()
    network.arrives(4)
    network.arrive(network.publish_other(5))
    network.arrives(7)
    network.arrive(network.publish_other(5000))
    network.arrives(8)
    network.ask_all()
    assert network.handed_on == [(0, 4), (-1, 5), (0, 7), (-1, 5000), (0, 8)]
    assert network.completion.unknown[Unknown.RESTART] == 1


@pytest.mark.parametrize("number", [5000, 2**62, 1])
@pytest.mark.parametrize("is_first", [False, True])
def test_a_copy_with_a_false_number_brings_nothing_twice(number: int, is_first: bool) -> None:
    """A robot would repeat the last minute, and a recording would have it twice."""
    network = Network()
    for _ in range(20):
        message = network.publish()
        if not is_first:
            network.arrive(message)
    utime = network._utime
    false = bytes(8) + PREFIX.pack(utime, 0, 19 + number, 1, 0)
    network.arrive(false)
    for _ in range(10):
        network.arrive(network.publish())
    network.ask_all()
    genuine = [each for each in network.numbers if each < 30]
    assert sorted(genuine)[-10:] == [*range(20, 30)]
    assert len(genuine) - len(set(genuine)) == (number == 1)  # the copy had the next number
    assert network.check.num_lost == 0
    assert not network.completion.unknown.total()


def test_at_the_end_everything_until_then_is_requested_and_nothing_later() -> None:
    """What was lost last, no later message shows."""
    network = Network()
    network.arrives(0)
    lost = [network.publish() for _ in range(5)]
    network.completion.end(network.now_s)
    network.arrive(lost[4])
    network.ask(2)
    later = network.publish()
    network.ask_all()
    network.arrive(later)
    assert network.numbers == [*range(6)]
    assert network.completion.num_refilled == 0  # nothing that arrived shows that they were missed


def test_one_lost_reply_does_not_give_up_the_end() -> None:
    """LCM may lose the datagram; then the end comes with the next reply."""
    network = Network()
    network.arrives(0)
    network.publish()
    network.completion.end(network.now_s)
    network.completion.fail(network.completion.request(), "timeout", "", network.now_s)
    network.ask_all()
    network.completion.abandon()
    assert network.numbers == [0, 1]
    assert not network.completion.unknown.total()


@pytest.mark.parametrize(
    ("code", "is_connected", "is_known"),
    [
        ("nothing-yet", True, True),  # nothing has been published for longer than it is kept
        ("disabled", True, True),  # a gateway without a history says nothing about its end
        ("no-gateway", True, True),  # one of an earlier version neither
        ("no-gateway", False, False),
        ("timeout", True, False),
        ("unreadable", True, False),
    ],
)
def test_an_end_that_nobody_knows_is_called_unknown(code: str, is_connected: bool, is_known: bool) -> None:
    """What was lost last, no later message shows."""
    network = Network()
    network.arrives(0)
    network.completion.end(network.now_s)
    end_s = network.now_s + 5.0
    while network.completion.due_s <= end_s:
        network.now_s = network.completion.due_s
        network.completion.fail(
            *(network.completion.request(), code, "", network.now_s), is_connected=is_connected
        )
    network.completion.abandon()
    assert network.completion.unknown[Unknown.END] == (not is_known)


def test_what_is_missing_at_the_end_is_counted() -> None:
    """Also what was let go, of which nothing later is there to show it."""
    network = Network(limit=3 * ENTRY)
    network.arrives(0)
    network.arrives(4)
    network.arrive(*(network.publish() for _ in range(5)))
    network.completion.abandon()
    assert network.numbers == [0, 4, 5, 6]
    assert [(gap.stop - gap.missing, gap.stop) for gap in network.check.gaps] == [(1, 4), (7, 10)]
    assert network.check.num_lost == 6


def test_the_last_seconds_come_before_the_first_message() -> None:
    network = Network(completeness=Completeness(is_complete=True, last_s=1.0))
    for _ in range(20):
        network.publish()
    network.arrives(20)
    assert network.completion.due_s == network.now_s
    assert network.completion.request().options == {"last_s": "1.000"}
    network.ask_all()
    assert network.numbers == [*range(15, 21)]


@pytest.mark.parametrize(("code", "patience_s"), [("no-gateway", NOBODY_S), ("timeout", PATIENCE_S)])
def test_why_the_last_seconds_are_given_up_is_known(code: str, patience_s: float) -> None:
    network = Network(completeness=Completeness(is_complete=True, last_s=1.0))
    network.arrives(3)
    end_s = network.now_s + patience_s
    while network.now_s < end_s:
        assert not network.completion.past_problem
        network.now_s = network.completion.due_s
        network.completion.fail(network.completion.request(), code, "nobody", network.now_s)
    assert network.numbers == [3]
    assert network.completion.past_problem == "nobody"


DISPLAY: Final = Completeness(last_s=1.0, patience_s=1.0)
"""What a display wants: the last seconds if they come at once, and then the newest messages."""


def test_a_display_gets_the_last_seconds_and_then_what_arrives() -> None:
    """A gap later is shown as lost, and holds up nothing."""
    network = Network(completeness=DISPLAY)
    network.arrives(20)
    network.ask_all()
    assert network.numbers == [*range(15, 21)]
    network.arrives(23)
    assert network.completion.due_s == math.inf
    assert network.numbers == [*range(15, 21), 23]
    assert network.check.num_lost == 2
    network.restart()
    network.arrives(0)
    assert network.handed_on[-1] == (1, 0)


@pytest.mark.parametrize("is_complete", [False, True])
def test_a_history_that_does_not_answer_delays_a_display_by_its_patience(is_complete: bool) -> None:
    """No more than once, and nothing counts as lost: nobody has missed what was before."""
    network = Network(completeness=DISPLAY._replace(is_complete=is_complete))
    begin_s = network.now_s
    network.arrives(20)
    while not network.handed_on:
        assert network.completion.reply_s(network.now_s) <= begin_s + 1.0 - network.now_s + 0.06
        network.now_s += 0.25
        network.arrive(network.publish())
    assert network.now_s == begin_s + 1.0
    assert network.numbers == [*range(20, 25)]
    network.arrive(network.publish())
    assert network.numbers == [*range(20, 26)]
    assert network.completion.due_s == math.inf
    assert network.check.num_lost == 0


def test_what_is_missing_in_what_waited_for_the_past_holds_up_nothing() -> None:
    network = Network(completeness=DISPLAY)
    network.arrives(20)
    network.arrives(22)
    network.completion.expire(network.now_s + 1.0)
    assert network.numbers == [20, 22]
    assert network.check.num_lost == 1


def test_a_complete_display_waits_for_a_gap_no_longer_than_its_patience() -> None:
    network = Network(completeness=Completeness(is_complete=True, patience_s=1.0))
    network.arrives(0)
    network.arrives(5)
    network.completion.expire(network.now_s + 0.9)
    assert network.numbers == [0]
    network.completion.expire(network.now_s + 1.1)
    assert network.numbers == [0, 5]
    assert network.check.num_lost == 4


def test_what_only_a_restarted_gateway_has_published_was_not_lost_before() -> None:
    """Nothing of its run has arrived, and the history says that there are more messages than before."""
    network = Network()
    for number in range(5):
        network.arrives(number)
    network.restart()
    for _ in range(10):
        network.publish()
    network.completion.notice(9, network._utime, network.now_s)
    network.ask_all()
    assert network.handed_on == [
        *((0, number) for number in range(5)),
        *((1, number) for number in range(10)),
    ]
    assert network.check.num_lost == 0
    assert network.completion.unknown[Unknown.RESTART] == 1


def test_the_last_seconds_of_a_key_that_is_silent_now() -> None:
    """An event of some seconds ago, of which nothing arrives that would show that there was one."""
    network = Network(completeness=DISPLAY)
    for _ in range(10):
        network.publish()
    network.completion.begin(network.now_s)
    assert network.completion.due_s == network.now_s
    network.ask_all()
    assert network.numbers == [*range(4, 10)]
    network.arrive(network.publish())
    assert network.numbers == [*range(4, 11)]
    assert not network.completion.is_past


def test_the_last_seconds_of_a_silent_key_may_come_late() -> None:
    """Nothing waits for them, so a gateway that is busy for a few seconds must not cost a display these."""
    network = Network(completeness=DISPLAY)
    for _ in range(10):
        network.publish()
    network.completion.begin(network.now_s)
    for _ in range(4):
        network.now_s = max(network.now_s, network.completion.due_s)
        assert network.completion.reply_s(network.now_s) == DISPLAY.patience_s
        request = network.completion.request()
        network.now_s += 1.0
        network.completion.fail(request, "timeout", "", network.now_s)
        network.completion.expire(network.now_s)
    network.ask_all()
    assert network.numbers == [*range(4, 10)]


def test_the_first_message_of_a_silent_key_without_an_answer_waits_for_the_patience() -> None:
    network = Network(completeness=DISPLAY)
    network.completion.begin(network.now_s)
    network.now_s += 10.0
    network.completion.expire(network.now_s)
    network.arrives(7)
    network.completion.expire(network.now_s + 0.9)
    assert not network.numbers
    network.completion.expire(network.now_s + 1.0)
    assert network.numbers == [7]
    assert network.completion.due_s == math.inf


def test_of_a_silent_key_that_nobody_answers_for_the_first_message_is_handed_on_at_once() -> None:
    network = Network(completeness=DISPLAY)
    network.completion.begin(network.now_s)
    begin_s = network.now_s
    while network.completion.due_s < math.inf:
        network.now_s = max(network.now_s, network.completion.due_s)
        network.completion.fail(network.completion.request(), "no-gateway", "", network.now_s)
    assert network.now_s == pytest.approx(begin_s + NOBODY_S, abs=0.2)
    network.arrives(7)
    assert network.numbers == [7]


def test_if_the_last_seconds_take_too_long_their_end_is_there_and_no_gap_follows() -> None:
    """A plot would begin again at a gap, and show nothing."""
    network = Network(completeness=DISPLAY)
    for _ in range(1000):
        network.publish()
    network.arrive(network.publish())

    def find(request: HistoryRequest) -> HistoryAnswer:
        first = int(request.options.get("from", 0))
        last = min(first + 19, int(request.options.get("to", 1000)))
        return HistoryAnswer(network.history[first : last + 1], first, last, 1000)

    while network.completion.is_past:
        network.now_s += 0.05
        request = network.completion.request()
        network.completion.answer(request, find(request), network.now_s)
        assert network.now_s < 101
    numbers = network.numbers
    [begin] = [after for before, after in itertools.pairwise(numbers) if after != before + 1]
    assert 100 < 1000 - begin < 300
    assert numbers[-1] == 1000
    assert network.check.num_lost == 0


def test_a_past_that_stops_coming_counts_as_lost_for_nobody() -> None:
    """A display shows what is live then; the rest of the past was before it began."""
    network = Network(completeness=DISPLAY)
    network.arrives(20)
    network.ask(2)
    assert network.numbers == [15, 16]
    network.completion.expire(network.now_s + 1.0)
    assert network.numbers == [15, 16, 20]
    assert network.check.num_lost == 0


def test_a_past_that_comes_after_the_patience_is_left_out() -> None:
    """A display would show the messages twice, and go back in time."""
    network = Network(completeness=DISPLAY)
    network.arrives(20)
    request = network.completion.request()
    network.completion.expire(network.now_s + 1.0)
    network.arrive(network.publish(), network.publish())
    answer = network.find(request)
    assert answer is not None
    network.completion.answer(request, answer, network.now_s)
    assert network.numbers == [20, 21, 22]
