"""``streams: auto`` with connections of several rates, against a plain model of its rules."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import cast

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from gateway.session.state import StreamState
from tests.support.automatic_streams import STALL_TIMEOUT_S, ScriptedStream, StreamsLab, announcing
from tests.support.examples import examples

THREE = {"3d": 200.0, "force": 1000.0, "analog": 2000.0}
TWO = {"3d": 200.0, "analog": 2000.0}
ONE = {"3d": 200.0}


@pytest.fixture
def lab() -> Iterator[StreamsLab]:
    lab = StreamsLab()
    yield lab
    lab.close()


def connect_all(lab: StreamsLab) -> None:
    for index in range(3):
        lab.connect(lab.connections[index], announcing(THREE))
        lab.show(lab.connections[index], StreamState.STREAMING)


@pytest.mark.parametrize("dead", [1, 2])
def test_one_dead_connection_of_three_is_given_up(lab: StreamsLab, dead: int) -> None:
    """Its neighbour has frames, and its own rate would never arrive."""
    connect_all(lab)
    lab.show(lab.connections[dead], StreamState.IDLE)
    for _ in range(4):
        lab.second()
    assert len(lab.connections) == 3
    lab.second()
    assert len(lab.connections) == 1


def test_seconds_with_frames_on_other_connections_only_count_in_a_row(lab: StreamsLab) -> None:
    """Those before a new connection, or before a break of all frames, say nothing about it."""
    connect_all(lab)
    interrupts: list[Callable[[], None]] = [
        lambda: lab.show(lab.connections[1], StreamState.IDLE),
        lambda: lab.end(lab.connections[0]),
        lambda: lab.show(lab.connections[0], StreamState.STREAMING),
    ]
    for interrupt in interrupts:
        lab.show(lab.connections[0], StreamState.IDLE)
        lab.show(lab.connections[2], StreamState.IDLE)
        for _ in range(4):
            lab.second()
        interrupt()
        lab.second()
        if lab.connections[0].session is None:
            connect_all(lab)
        lab.show(lab.connections[1], StreamState.STREAMING)
    assert len(lab.connections) == 3


@pytest.mark.parametrize("young", [1, 2])
def test_an_old_connection_does_not_excuse_what_a_young_one_may_have_caused(
    lab: StreamsLab, young: int
) -> None:
    """The first connection ends again and again, soon after one of two others was opened."""
    for _ in range(2):
        connect_all(lab)
        lab.second()
        lab.end(lab.connections[0])
    connect_all(lab)
    for _ in range(4):
        lab.second()
    lab.end(lab.connections[young])
    lab.second(0.5)
    lab.connect(lab.connections[young], announcing(THREE))
    lab.show(lab.connections[young], StreamState.STREAMING)
    lab.second()
    lab.end(lab.connections[0])
    assert len(lab.connections) == 1


@dataclass
class Further:
    """A further connection of the model: since when it is wanted, and its last seconds."""

    opened_s: float
    breaks: int = 0
    without_frames: int = 0
    without_bytes: int = 0
    has_answered: bool = False


class Streams(RuleBasedStateMachine):
    """Connections that die, stall, come back and restart; the model counts seconds and failures.

    The model is the rules of docs/explanation/streams: three failures of the first connection soon after
    another one was opened, two early ends of another one, or seconds with frames on some of them only lead to
    one connection. This is remembered for the same server, for ten minutes or until it changes.
    """

    def __init__(self) -> None:
        super().__init__()
        self.lab = StreamsLab()
        self.first = self.lab.connections[0]
        self.rates = dict(THREE)
        self.version = "1"
        self.knows_names = True
        # The model.
        self.further: dict[int, Further] = {}  # of the present connection of the first, by position
        self.first_failures = 0
        self.first_waiting = 0
        self.one_until_s: float | None = None  # one connection for this server; inf for good
        self.one_for: object = None
        self.plan_for: object = None  # the server at the newest handshake of the first connection
        self.num_planned = 1

    def teardown(self) -> None:
        self.lab.close()

    # The model.

    @property
    def now_s(self) -> float:
        return self.lab.loop.now_s

    @property
    def server(self) -> object:
        return (self.version, tuple(sorted(self.rates.items())))

    def plan(self) -> None:
        self.plan_for = self.server
        self.num_planned = len(set(self.rates.values()))
        if self.one_until_s is not None and self.num_planned > 1:
            if self.one_for == self.server and self.now_s < self.one_until_s:
                self.num_planned = 1
            else:
                self.one_until_s = None
                self.first_failures = 0

    def give_up(self, *, for_good: bool = False) -> None:
        self.one_until_s = float("inf") if for_good else self.now_s + 600
        self.one_for = self.plan_for
        self.num_planned = 1
        self.further.clear()

    # The world.

    def is_connected(self, position: int) -> bool:
        return position < len(self.lab.connections) and self.lab.connections[position].session is not None

    @precondition(lambda self: self.first.session is None)
    @rule()
    def connect_first(self) -> None:
        self.lab.connect(self.first, announcing(self.rates, self.version), names=self.knows_names)
        self.first_waiting = 0
        self.plan()
        if self.num_planned > 1 and not self.knows_names:
            self.give_up(for_good=True)
        self.further = {position: Further(self.now_s) for position in range(1, self.num_planned)}

    @rule(
        breaks=st.sampled_from([None, 0, 0, 1, 2]),
        again=st.integers(0, 3),
        seconds=st.sampled_from([0.5, 4, 11]),
    )
    def connect_everything(self, breaks: int | None, again: int, seconds: float) -> None:
        """All connections get frames; then one of them may break, again and again."""
        for _ in range(again + 1):
            if self.first.session is None:
                self.connect_first()
            for position in range(len(self.lab.connections)):
                if position:
                    self.connect_further(position)
                self.show(position, StreamState.STREAMING)
            if breaks is not None:
                self.wait(set(), 1, seconds)
            if breaks == 0:
                self.end_first(False)
            elif breaks is not None:
                self.end_further(breaks)

    @precondition(lambda self: self.first.session is not None)
    @rule(position=st.integers(1, 2))
    def connect_further(self, position: int) -> None:
        if position in self.further and not self.is_connected(position):
            self.lab.connect(self.lab.connections[position], announcing(self.rates, self.version))
            self.further[position].opened_s = self.now_s

    @rule(
        position=st.integers(0, 2),
        state=st.sampled_from([StreamState.STREAMING, StreamState.NO_MEASUREMENT, StreamState.IDLE]),
    )
    def show(self, position: int, state: StreamState) -> None:
        if self.is_connected(position):
            self.lab.show(self.lab.connections[position], state)

    @rule(
        answers=st.sets(st.integers(1, 2)),
        times=st.integers(1, 6),
        seconds=st.sampled_from([0.3, 1.0, 1.0, 3.0]),
    )
    def wait(self, answers: set[int], times: int, seconds: float) -> None:
        """Let seconds pass, in which some connections have replies but maybe no frames."""
        for _ in range(times):
            for position in answers:
                if position in self.further:
                    self.lab.connections[position].status.bytes_in += 10
                    self.further[position].has_answered = True
            states = [stream.status.state for stream in self.lab.connections]
            self.lab.second(seconds)
            self.check(states)

    def check(self, states: list[StreamState]) -> None:
        if self.first.session is None or not self.further:
            return
        has_frames = [state in {StreamState.STREAMING, StreamState.NO_MEASUREMENT} for state in states]
        if has_frames[0]:
            self.first_waiting = 0
            for position, each in self.further.items():
                each.without_frames = 0 if has_frames[position] else each.without_frames + 1
                is_quiet = not has_frames[position] and not each.has_answered
                each.has_answered = False
                each.without_bytes = each.without_bytes + 1 if is_quiet else 0
            if any(each.without_frames >= 15 or each.without_bytes >= 5 for each in self.further.values()):
                ages_s = [self.now_s - each.opened_s for each in self.further.values()]
                self.give_up()
                if all(age_s > 2 + STALL_TIMEOUT_S for age_s in ages_s):
                    self.first_failures = 0
                return
        elif StreamState.STREAMING in states[1:]:
            self.first_waiting += 1
            if self.first_waiting >= 5:
                ages_s = [self.now_s - each.opened_s for each in self.further.values()]
                self.give_up()
                if all(age_s > 2 + STALL_TIMEOUT_S for age_s in ages_s):
                    self.first_failures = 0
                return
        else:
            self.first_waiting = 0
        if all(self.now_s - each.opened_s > 2 + STALL_TIMEOUT_S for each in self.further.values()):
            self.first_failures = 0

    @precondition(lambda self: self.first.session is not None)
    @rule(is_silent=st.booleans())
    def end_first(self, is_silent: bool) -> None:
        since_s = 2 + (STALL_TIMEOUT_S if is_silent else 0)
        if any(self.now_s - each.opened_s < since_s for each in self.further.values()):
            self.first_failures += 1
            if self.first_failures >= 3:
                self.give_up(for_good=True)
        self.further.clear()
        self.lab.end(self.first, is_silent=is_silent)

    @rule(position=st.integers(1, 2))
    def end_further(self, position: int) -> None:
        if position not in self.further or not self.is_connected(position):
            return
        each = self.further[position]
        each.breaks = each.breaks + 1 if self.now_s - each.opened_s < 10 else 1
        stream = self.lab.connections[position]
        self.lab.end(stream)
        if each.breaks >= 2:
            self.give_up()

    @rule(
        rates=st.sampled_from([THREE, THREE, TWO, ONE]),
        version=st.sampled_from(["1", "1", "2"]),
        knows_names=st.sampled_from([True, True, True, False]),
    )
    def replace_server(self, rates: dict[str, float], version: str, knows_names: bool) -> None:
        """The next handshake is with this server; all connections end."""
        if self.first.session is not None:
            self.end_first(False)
        self.rates, self.version, self.knows_names = rates, version, knows_names

    @rule(minutes=st.sampled_from([5, 11]), reconnects=st.booleans())
    def let_minutes_pass(self, minutes: int, reconnects: bool) -> None:
        """Nobody checks meanwhile, as while the process is stopped. A verdict may hold for ten minutes."""
        self.lab.loop.now_s += 60 * minutes
        if reconnects and self.first.session is not None:
            self.end_first(False)
        if self.first.session is None:
            self.connect_first()

    @invariant()
    def the_plan_is_that_of_the_model(self) -> None:
        assert len(self.lab.connections) == self.num_planned
        assert self.first.is_running

    @invariant()
    def exactly_the_further_connections_of_the_plan_run(self) -> None:
        known = [cast("ScriptedStream", stream) for stream in self.lab.streams.known[1:]]
        running = [stream for stream in known if stream.is_running]
        expected = self.lab.connections[1:] if self.first.session is not None else []
        assert {id(stream) for stream in running} == {id(stream) for stream in expected}

    @invariant()
    def every_component_is_on_one_connection(self) -> None:
        components = [each for stream in self.lab.connections for each in stream.settings.components]
        assert len(components) == len(set(components)) == 5


def test_the_connections_follow_the_rules_in_any_order_of_events() -> None:
    run_state_machine_as_test(Streams, settings=settings(max_examples=examples(100), stateful_step_count=30))
