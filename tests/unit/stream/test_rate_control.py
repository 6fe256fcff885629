from collections.abc import Sequence
from itertools import pairwise

import pytest

from gateway.rtc3d.commands import AllFrames, Frequency, FrequencyDivisor, Rate
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.stream.rate_control import (
    FIRST_WAIT_S,
    MAX_HALVINGS,
    MAX_WAIT_S,
    LagControl,
    halved,
    stream_requests,
)

TWO = (ComponentType.MARKERS, ComponentType.TOOLS)


def texts(rate: Rate, components: Sequence[ComponentType], server_rate_hz: float | None) -> list[str]:
    return [str(request) for request in stream_requests(rate, components, server_rate_hz)]


def test_the_configured_rate_and_components_are_requested_first() -> None:
    assert texts(Frequency(60), TWO, 100)[0] == "StreamFrames Frequency:60 3D 6D"


def test_all_components_are_requested_without_names() -> None:
    backwards = WIRE_ORDER[::-1]
    assert texts(AllFrames(), backwards, None)[0] == "StreamFrames AllFrames"


def test_all_frames_fall_back_to_the_divisor_1() -> None:
    assert texts(AllFrames(), TWO, 100) == [
        "StreamFrames AllFrames 3D 6D",
        "StreamFrames AllFrames",
        "StreamFrames FrequencyDivisor:1",
        "StreamFrames",
    ]


def test_a_frequency_falls_back_to_a_divisor_of_the_servers_rate() -> None:
    assert texts(Frequency(50), TWO, 200) == [
        "StreamFrames Frequency:50 3D 6D",
        "StreamFrames Frequency:50",
        "StreamFrames FrequencyDivisor:4",
        "StreamFrames",
    ]


@pytest.mark.parametrize(
    ("wanted_hz", "server_rate_hz", "divisor"),
    [(60, 100, 2), (70, 100, 1), (30, 100, 3), (0.5, 100, 200), (500, 100, 1)],
)
def test_the_divisor_is_the_nearest_one_and_at_least_1(
    wanted_hz: float, server_rate_hz: float, divisor: int
) -> None:
    assert f"StreamFrames FrequencyDivisor:{divisor}" in texts(Frequency(wanted_hz), TWO, server_rate_hz)


@pytest.mark.parametrize("server_rate_hz", [None, 0.0])
def test_without_the_servers_rate_a_frequency_has_no_divisor(server_rate_hz: float | None) -> None:
    assert texts(Frequency(50), TWO, server_rate_hz) == [
        "StreamFrames Frequency:50 3D 6D",
        "StreamFrames Frequency:50",
        "StreamFrames",
    ]


def test_a_divisor_is_kept() -> None:
    assert texts(FrequencyDivisor(4), TWO, 200) == [
        "StreamFrames FrequencyDivisor:4 3D 6D",
        "StreamFrames FrequencyDivisor:4",
        "StreamFrames",
    ]


@pytest.mark.parametrize("rate", [AllFrames(), Frequency(100), FrequencyDivisor(1)])
def test_no_request_is_repeated(rate: Rate) -> None:
    requests = texts(rate, WIRE_ORDER, 100)
    assert len(set(requests)) == len(requests)
    assert requests[-1] == "StreamFrames"


FRAME_S = 0.005


class Link:
    """A link that carries part of the full rate: at a higher rate, frames are late. Time is simulated."""

    def __init__(self, carries_halvings: int) -> None:
        self.control = LagControl(max_lag_s=0.05)
        self.carries_halvings = carries_halvings
        self.now_s = 0.0
        self.changes: list[tuple[float, int]] = []

    def run(self, seconds: float) -> None:
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += FRAME_S
            late = self.control.halvings < self.carries_halvings
            if self.control.observe(self.now_s, 0.2 if late else 0.001):
                self.changes.append((self.now_s, self.control.halvings))


def test_frames_in_time_do_not_change_the_rate() -> None:
    link = Link(carries_halvings=0)
    link.run(1000)
    assert link.changes == []


def test_lateness_of_less_than_a_second_does_not_change_the_rate() -> None:
    link = Link(carries_halvings=1)
    for _ in range(20):
        link.carries_halvings = 1
        link.run(0.9)
        link.carries_halvings = 0
        link.run(0.1)
    assert link.changes == []


def test_the_rate_is_halved_until_frames_arrive_in_time() -> None:
    link = Link(carries_halvings=3)
    link.run(5)
    assert [halvings for _, halvings in link.changes] == [1, 2, 3]


def test_the_rate_returns_to_the_configured_one_by_steps_of_ten_seconds() -> None:
    link = Link(carries_halvings=2)
    link.run(5)
    link.carries_halvings = 0
    link.run(100)
    assert [halvings for _, halvings in link.changes] == [1, 2, 1, 0]
    assert link.changes[2][0] - link.changes[1][0] == pytest.approx(FIRST_WAIT_S, abs=0.1)


def test_the_wait_after_failed_steps_up_doubles_to_five_minutes() -> None:
    link = Link(carries_halvings=1)
    link.run(4000)
    ups = [time_s for time_s, halvings in link.changes if halvings == 0]
    waits = [round(later - earlier) for earlier, later in pairwise(ups)]
    assert waits == sorted(waits)
    assert waits[0] == pytest.approx(2 * FIRST_WAIT_S, abs=2)
    assert waits[-1] == pytest.approx(MAX_WAIT_S, abs=2)
    assert all(halvings <= 1 for _, halvings in link.changes)


def test_a_step_up_that_lasts_resets_the_wait() -> None:
    link = Link(carries_halvings=1)
    link.run(200)
    assert link.control.wait_s > FIRST_WAIT_S
    link.carries_halvings = 0
    link.run(1000)
    link.carries_halvings = 1
    link.run(2)
    assert link.control.wait_s == FIRST_WAIT_S


def test_halvings_are_bounded() -> None:
    link = Link(carries_halvings=100)
    link.run(1000)
    assert link.control.halvings == MAX_HALVINGS
    assert len(link.changes) == MAX_HALVINGS


@pytest.mark.parametrize(
    ("rate", "expected"),
    [
        (AllFrames(), FrequencyDivisor(4)),
        (None, FrequencyDivisor(4)),
        (FrequencyDivisor(3), FrequencyDivisor(12)),
        (Frequency(60), Frequency(15)),
    ],
)
def test_a_rate_is_halved_twice(rate: Rate | None, expected: Rate) -> None:
    assert halved(rate, 2) == expected
    assert halved(rate, 0) == rate


@pytest.mark.parametrize(
    ("rate", "expected"),
    [
        (AllFrames(), FrequencyDivisor(32)),
        (FrequencyDivisor(3), FrequencyDivisor(96)),
        (Frequency(64), Frequency(2)),
    ],
)
def test_rates_halved_five_times(rate: Rate, expected: Rate) -> None:
    assert halved(rate, 5) == expected


def test_a_restart_forgets_that_frames_were_late() -> None:
    control = LagControl(max_lag_s=0.05)
    control.observe(0.0, 0.2)
    control.restart()
    assert control.is_late is False
    assert not control.observe(0.5, 0.2)
    assert not control.observe(1.25, 0.2)
    assert control.observe(1.5, 0.2)


def test_after_a_restart_frames_must_be_in_time_for_the_whole_wait_again() -> None:
    control = LagControl(max_lag_s=0.05)
    control.observe(0.0, 0.2)
    control.observe(1.0, 0.2)
    control.observe(2.0, 0.0)
    control.restart()
    assert not control.observe(11.0, 0.0)
    assert not control.observe(20.9, 0.0)
    assert control.observe(21.0, 0.0)
    assert control.halvings == 0


def test_the_second_step_up_comes_exactly_one_wait_after_the_first() -> None:
    control = LagControl(max_lag_s=0.05)
    for now_s in (0.0, 1.0, 2.0):
        control.observe(now_s, 0.2)
    steps = [control.observe(3.0 + elapsed_s, 0.0) for elapsed_s in (0.0, 10.0, 20.0)]
    assert steps == [False, True, True]
    assert control.halvings == 0
