"""Filling gaps, in random schedules of outages, restarts, lost and late answers and false numbers.

The model is plain: what each run of the gateway has published, and what of it was handed on. Whatever
happens, nothing comes twice or in another order, and a recording is called complete only if it is.
"""

import itertools
import math
from typing import Final, NamedTuple

from hypothesis import assume, example, given, note, settings
from hypothesis import strategies as st

from gateway.client.arrived_run import HeldBytes
from gateway.client.completion import Completion
from gateway.client.completion_states import Unknown
from gateway.client.history_requests import HistoryAnswer, HistoryRequest
from gateway.messages.encode import PREFIX
from gateway.messages.history import sequence_of, utime_of
from gateway.messages.sequence_check import SequenceCheck
from tests.support.examples import examples

_ID: Final = slice(8 + PREFIX.size, None)
_STEP_US: Final = 1000


class Published(NamedTuple):
    """A message that a gateway has published."""

    run: int
    number: int


class Gateway:
    """A gateway and its history of the newest ``window`` messages."""

    def __init__(self, window: int = 10**9) -> None:
        self.window = window
        self.run = 0
        self.number = 0
        self.history: list[bytes] = []

    def publish(self, utime: int, identity: int) -> bytes:
        message = encode(self.number, utime, identity)
        self.number += 1
        self.history = [*self.history, message][-self.window :]
        return message

    def restart(self) -> None:
        self.run, self.number, self.history = self.run + 1, 0, []

    def find(self, request: HistoryRequest, max_messages: int) -> HistoryAnswer | None:
        if not self.history:
            return None
        options = request.options
        newest = sequence_of(self.history[-1])
        if "since_utime" in options:
            since = int(options["since_utime"])
            later = (sequence_of(each) for each in self.history if utime_of(each) >= since)
            first = next(later, newest + 1)
        else:
            first = int(options["from"])
        last = min(int(options.get("to", newest)), newest)
        found = [each for each in self.history if first <= sequence_of(each) <= last]
        if len(found) > max_messages:
            found = found[:max_messages]
            last = sequence_of(found[-1])
        return HistoryAnswer(found, first, last, newest)


def encode(number: int, utime: int, identity: int) -> bytes:
    return bytes(8) + PREFIX.pack(utime, 0, number, 1, 0) + identity.to_bytes(8, "big")


class World:
    """A gateway, another one with the same name, and a subscriber; time passes with each event."""

    def __init__(self, window: int, limit: int) -> None:
        self.gateway, self.other = Gateway(window), Gateway()
        self.other.number = 700
        self.room = HeldBytes(limit)
        self.check = SequenceCheck(counts_first=True, max_listed=100)
        self.completion = Completion(self.hand_on, self.check, self.room)
        self.published: dict[int, Published] = {}
        """By identity; those of the other gateway have run -1, those with a false number -2."""
        self.handed_on: list[Published] = []
        self.arrived: set[Published] = set()
        self.has_room = True
        self.now_s = 100.0
        self.utime = 10**9
        self.newest: bytes | None = None
        self.asked: tuple[HistoryRequest, HistoryAnswer | None] | None = None

    def hand_on(self, message: bytes) -> None:
        self.check.add(sequence_of(message), utime_of(message), 1)
        self.handed_on.append(self.published[int.from_bytes(message[_ID], "big")])

    def publish(self) -> bytes:
        self.utime += _STEP_US
        identity = len(self.published)
        self.published[identity] = Published(self.gateway.run, self.gateway.number)
        self.newest = self.gateway.publish(self.utime, identity)
        return self.newest

    def publish_other(self) -> bytes:
        self.utime += _STEP_US
        identity = len(self.published)
        self.published[identity] = Published(-1, self.other.number)
        return self.other.publish(self.utime, identity)

    def falsify(self, number: int) -> bytes:
        """Return a copy of the newest message with another number."""
        assert self.newest is not None
        identity = len(self.published)
        self.published[identity] = Published(-2, number)
        return encode(number, utime_of(self.newest), identity)

    def arrive(self, message: bytes) -> None:
        self.arrived.add(self.published[int.from_bytes(message[_ID], "big")])
        self.completion.receive(
            *(message, sequence_of(message), utime_of(message), 1, self.now_s), has_room=self.has_room
        )

    @property
    def is_due(self) -> bool:
        return self.completion.due_s <= self.now_s and self.has_room

    def ask(self, max_messages: int = 7) -> None:
        request = self.completion.request()
        self.reply(request, self.gateway.find(request, max_messages))

    def reply(self, request: HistoryRequest, answer: HistoryAnswer | None) -> None:
        if answer is None:
            self.completion.fail(request, "nothing-yet", "", self.now_s)
        else:
            self.completion.answer(request, answer, self.now_s)

    def do(self, event: str) -> None:  # noqa: C901, PLR0912 - one event after the other
        self.now_s += 0.02
        match event:
            case "arrives":
                self.arrive(self.publish())
            case "twice":
                message = self.publish()
                self.arrive(message)
                self.arrive(message)
            case "lost":
                self.publish()
            case "many lost":
                for _ in range(20):
                    self.publish()
            case "restart":
                self.gateway.restart()
                self.utime += 50 * _STEP_US
            case "clock set back" if self.completion.due_s == math.inf:
                self.gateway.restart()
                self.utime -= 10**8
            case "full":
                self.has_room = False
            case "room":
                self.has_room = True
            case "pause":
                self.now_s += 3.0
            case "ask" if self.is_due:
                self.ask()
            case "no reply" | "busy" if self.is_due:
                code = "timeout" if event == "no reply" else "busy"
                self.completion.fail(self.completion.request(), code, "", self.now_s)
            case "partly lost" if self.is_due:
                request = self.completion.request()
                answer = self.gateway.find(request, 7)
                if answer is not None and answer.messages:
                    answer = answer._replace(messages=answer.messages[1::2], is_whole=False)
                self.reply(request, answer)
            case "begin to ask" if self.is_due:
                request = self.completion.request()
                self.asked = request, self.gateway.find(request, 7)
            case "late answer" if self.asked is not None:
                self.reply(*self.asked)
                self.asked = None
            case "far ahead" if self.newest is not None:
                self.arrive(self.falsify(self.gateway.number + 5000))
            case "absurd" if self.newest is not None:
                self.arrive(self.falsify(2**62))
            case "a little ahead" if self.newest is not None:
                self.arrive(self.falsify(self.gateway.number + 2))

    def finish(self) -> None:
        """Let everything be requested until now, as at the end of a recording."""
        self.has_room = True
        if self.asked is not None:
            self.reply(*self.asked)
        self.now_s += 0.1
        if not self.gateway.history:
            self.publish()  # a gateway sends a status every second, which shows that it has restarted
        self.completion.end(self.now_s)
        self.fetch()
        self.completion.abandon()

    def fetch(self) -> None:
        for _ in range(20_000):
            if self.completion.due_s == math.inf:
                return
            self.now_s = max(self.now_s, self.completion.due_s)
            self.ask(10)
        raise AssertionError("it never ends")

    @property
    def is_called_complete(self) -> bool:
        return not self.check.num_lost and not self.completion.unknown.total()

    def missing(self) -> set[Published]:
        """Return what was published since the first message that was handed on, and was not."""
        genuine = [each for each in self.published.values() if each.run >= 0]
        first = next((each for each in self.handed_on if each.run >= 0), None)
        if first is None:
            return set()
        return set(genuine[genuine.index(first) :]) - set(self.handed_on)


USUAL: Final = ["arrives"] * 8 + ["lost"] * 2 + ["many lost", "twice", "full", "room", "pause"]
ASKING: Final = ["ask"] * 4 + ["no reply", "busy", "partly lost", "begin to ask", "late answer"]
RESTARTS: Final = ["restart", "restart", "clock set back"]
FALSE: Final = ["far ahead", "absurd", "a little ahead"]


def schedules(*events: str) -> st.SearchStrategy[list[str]]:
    return st.lists(st.sampled_from(events), max_size=50)


@settings(max_examples=examples(300))
@given(
    st.one_of(schedules(*USUAL, *ASKING, *RESTARTS), schedules(*USUAL, *ASKING, *RESTARTS, *FALSE)),
    st.sampled_from([10**9, 10**9, 15, 3]),
    st.sampled_from([10**9, 1000]),
)
@example(
    ["full", "restart", *["arrives"] * 4], 3, 10**9
)  # the first messages of the new run are held nowhere
@example(
    [*["arrives"] * 2, "restart", "lost", *["arrives"] * 2, "ask", "ask", "restart", "ask"], 10**9, 10**9
)  # a run ends whose first message never came
def test_nothing_comes_twice_and_what_is_called_complete_is(
    events: list[str], window: int, limit: int
) -> None:
    """Whatever the network, the gateway and another program do."""
    world = played(events, window, limit, is_in_order=not {*events} & {*FALSE})
    if world.is_called_complete:
        assert not world.missing()


@settings(max_examples=examples(300))
@given(schedules(*USUAL, *ASKING, *RESTARTS), st.sampled_from([10**9, 1000]))
@example(
    ["full", "restart", "arrives", "room", "restart", "ask", "ask"], 10**9
)  # the last run is still silent
def test_what_is_published_since_a_restart_comes(events: list[str], limit: int) -> None:
    """Also of a key of which nothing arrives after it, and while the program has no room."""
    world = played(events, 10**9, limit)
    assert not [each for each in world.missing() if each.run == world.gateway.run]
    has_restarted = len({each.run for each in world.handed_on}) > 1
    assert world.completion.unknown[Unknown.RESTART] >= has_restarted


def played(events: list[str], window: int, limit: int, *, is_in_order: bool = True) -> World:
    """Return the world after these events, and the end."""
    world = World(window, limit)
    world.do("arrives")
    for event in events:
        world.do(event)
    world.finish()
    note(f"handed on {world.handed_on}; lost {world.check.num_lost}, unknown {world.completion.unknown}")
    genuine = [each for each in world.handed_on if each.run >= 0]
    assert genuine == sorted(set(genuine)) or not is_in_order
    assert world.room.used == 0
    # If a run seems to go on with the next number, and no smaller one has arrived, nothing shows the restart.
    for a, b in itertools.pairwise(genuine):
        is_visible = any(each.run == b.run and each.number <= a.number for each in world.arrived)
        assume(a.run == b.run or b.number != a.number + 1 or is_visible)
    return world


@settings(max_examples=examples(300))
@given(schedules(*USUAL, *ASKING, *FALSE), st.sampled_from([10**9, 1000]))
def test_without_a_restart_false_numbers_change_nothing(events: list[str], limit: int) -> None:
    """No loss is reported that was none, and no message comes from the past."""
    world = played(events, 10**9, limit)
    assert not world.missing()
    assert world.is_called_complete
    assert world.check.num_restarts == 0
    assert [each.number for each in world.handed_on] == [*range(world.gateway.number)]
