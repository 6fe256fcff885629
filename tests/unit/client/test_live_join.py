"""What waits in a join, with frames of the test."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Self

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.client import live_join
from gateway.client.live_join import MAX_WAIT_S, Join
from tests.support.examples import examples


@dataclass
class JoinedFrame:
    """A frame that remembers the others with which it was joined."""

    key: str
    sequence: int
    session: int = 1
    source: str = "lab"
    capture_utime: int = 0
    steady_offset_us: int = 0
    others: list[Any] = field(default_factory=list)

    @property
    def timestamp_us(self) -> int:
        return 1000 * self.sequence

    def joined(self, others: Iterable[Self]) -> Self:
        self.others = [(other.key, other.sequence) for other in others]
        return self


def add(join: Join, *frames: JoinedFrame) -> None:
    for frame in frames:
        join.add(frame, 0.0)  # type: ignore[arg-type] # it has what a join needs


def test_a_message_that_was_overtaken_does_not_start_the_source_again() -> None:
    """LCM may deliver in another order: what waits would be forgotten each time."""
    join = Join(["lab"], ["3d", "analog"])
    add(join, *(JoinedFrame("3d", number) for number in (0, 2, 1)))
    add(join, *(JoinedFrame("analog", number) for number in range(3)))
    assert [frame.sequence for frame in join.take(0.0)] == [0, 2, 1]
    assert join.num_dropped == 0


def test_if_the_first_component_stops_the_others_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_join, "MAX_FRAMES", 10)
    join = Join(["lab"], ["3d", "analog"])
    add(join, *(JoinedFrame("analog", number) for number in range(30)))
    assert join.num_dropped == 20
    add(join, JoinedFrame("3d", 29))
    [frame] = join.take(0.0)
    assert frame.others == [("analog", number) for number in range(20, 30)]  # type: ignore[attr-defined]


def test_if_the_time_stamps_start_again_nothing_of_before_is_joined() -> None:
    """A frame of the former measurement would have the channels of the new one."""
    join = Join(["lab"], ["3d", "analog"])
    add(join, JoinedFrame("analog", 7), JoinedFrame("3d", 8), JoinedFrame("3d", 9))
    add(join, JoinedFrame("3d", 0, session=2), JoinedFrame("analog", 0, session=2))
    [frame] = join.take(0.0)
    assert (frame.session, frame.sequence) == (2, 0)
    assert frame.others == [("analog", 0)]  # type: ignore[attr-defined]
    assert join.num_dropped == 3


EVENTS = st.lists(
    st.sampled_from(["3d", "3d", "analog", "analog", "analog late", "restart", "wait", "take"]), max_size=40
)


@settings(max_examples=examples(200))
@given(EVENTS)
def test_each_frame_is_given_once_and_in_order_or_counted(events: list[str]) -> None:
    """A plain model: every frame is either given, given with another, still waiting, or dropped."""
    join = Join(["lab"], ["3d", "analog"])
    session, numbers, now_s = 1, {"3d": 0, "analog": 0}, 0.0
    late: list[JoinedFrame] = []
    added: list[tuple[int, str, int]] = []
    given_frames: list[Any] = []

    def put(frame: JoinedFrame) -> None:
        added.append((frame.session, frame.key, frame.sequence))
        join.add(frame, now_s)  # type: ignore[arg-type] # it has what a join needs

    for event in events:
        match event:
            case "3d" | "analog":
                put(JoinedFrame(event, numbers[event], session))
                numbers[event] += 1
            case "analog late":
                late.append(JoinedFrame("analog", numbers["analog"], session))
                numbers["analog"] += 1
            case "restart":
                late.clear()
                session, numbers = session + 1, {"3d": 0, "analog": 0}
            case "wait":
                now_s += MAX_WAIT_S
                for frame in late:
                    put(frame)
                late.clear()
            case "take":
                given_frames += join.take(now_s)
    given_frames += join.take(now_s + MAX_WAIT_S)
    instants = [(frame.session, frame.sequence) for frame in given_frames]
    assert instants == sorted(set(instants))
    num_others = sum(len(frame.others) for frame in given_frames)
    waiting = sum(map(len, join._waiting.values()))
    assert len(added) == len(given_frames) + num_others + waiting + join.num_dropped


PERIOD_US = 10_000
OFFSETS_US = st.sampled_from([-3_600_000_000, -3_000_000, 0, 3_000_000, 3_600_000_000])


@given(
    clocks=st.tuples(OFFSETS_US, OFFSETS_US),
    first_known=st.tuples(OFFSETS_US, OFFSETS_US),
    settles_at=st.tuples(st.integers(0, 12), st.integers(0, 12)),
    errors_us=st.lists(st.integers(0, 4_000), min_size=2, max_size=2),
)
def test_frames_of_two_gateways_are_paired_by_their_true_times_of_capture(
    clocks: tuple[int, int], first_known: tuple[int, int], settles_at: tuple[int, int], errors_us: list[int]
) -> None:
    """A model: what is known of each clock is wrong at first, and then right but for the network's delay.

    Nothing is taken before both are right: all frames that wait were read with what was known before.
    """
    join, names = Join(["lab", "stage"], ["3d"]), ("lab", "stage")
    for number in range(14):
        true_us = 10**12 + PERIOD_US * number
        for index, name in enumerate(names):
            clock_us = clocks[index]
            known_us = clock_us + errors_us[index] if number >= settles_at[index] else first_known[index]
            frame = JoinedFrame("3d", number, source=name, steady_offset_us=known_us)
            frame.capture_utime = true_us - clock_us - (5_000 if name == "stage" else 0)
            add(join, frame)
    taken: list[Any] = join.take(MAX_WAIT_S)
    assert [(frame.sequence, frame.others) for frame in taken] == [
        (number, [("3d", number)]) for number in range(14)
    ]


@pytest.mark.parametrize("step_us", [-3_600_000_000, -3_000_000])
def test_a_clock_that_is_set_back_does_not_keep_the_frames_of_before_waiting(step_us: int) -> None:
    """All that comes later would wait behind them, for as long as the clock was set back."""
    join = Join(["lab", "stage"], ["3d"])
    given_frames: list[Any] = []
    for number in range(10):
        true_us = 10**12 + PERIOD_US * number
        set_us = step_us if number >= 5 else 0
        stage = JoinedFrame("3d", number, source="stage", capture_utime=true_us + set_us)
        stage.steady_offset_us = -set_us
        add(join, stage)
        if number == 5:  # the frames of lab come late
            add(
                join, *(JoinedFrame("3d", each, capture_utime=10**12 + PERIOD_US * each) for each in range(6))
            )
        elif number > 5:
            add(join, JoinedFrame("3d", number, capture_utime=true_us))
        given_frames += join.take(0.0)
    assert [(frame.sequence, frame.others) for frame in given_frames] == [
        (number, [("3d", number)]) for number in range(10)
    ]


def test_two_sources_of_one_gateway_are_paired_by_its_times_alone() -> None:
    """What is known of its clock is not the same for both, by the delays of their messages."""
    join = Join(["lab", "stage"], ["3d"])
    for number in range(4):
        known_us = {"lab": 3_000_000, "stage": 3_000_000 + 15_000}
        for name, offset_us in known_us.items():
            capture_utime = 10**12 + PERIOD_US * number
            frame = JoinedFrame("3d", number, source=name, capture_utime=capture_utime)
            frame.steady_offset_us = offset_us
            add(join, frame)
    taken: list[Any] = join.take(MAX_WAIT_S)
    assert [frame.others for frame in taken] == [[("3d", number)] for number in range(4)]
