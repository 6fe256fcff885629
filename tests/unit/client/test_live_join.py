"""What waits in a join, with frames of the test."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Self

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.client import live_join
from gateway.client.live_join import MAX_WAIT_S, Join


@dataclass
class JoinedFrame:
    """A frame that remembers the others with which it was joined."""

    key: str
    sequence: int
    session: int = 1
    source: str = "lab"
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


@settings(max_examples=200)
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
