from collections.abc import Iterable

import pytest

from gateway.rtc3d.components import ComponentType
from gateway.simulator.recorded.timeline import TakeTimeline

START = 1_700_000_000_000_000
PERIOD_US = 10_000
MARKERS, ANALOG = ComponentType.MARKERS, ComponentType.ANALOG


def times(messages: Iterable[tuple[int, int]]) -> list[int]:
    """Return the times of (time stamp, time of capture since START) of one component."""
    timeline = TakeTimeline()
    return [timeline.time_us(MARKERS, 1, stamp, START + captured) for stamp, captured in messages]


def regular(count: int, first_us: int = 0) -> list[int]:
    return list(range(first_us, first_us + count * PERIOD_US, PERIOD_US))


def test_time_stamps_count_while_capture_times_agree_with_them() -> None:
    jitter = [0, 7000, -3000, 40_000, 1000] * 60
    messages = [(5_000_000 + k * PERIOD_US, k * PERIOD_US + jitter[k]) for k in range(300)]
    assert times(messages) == regular(300)


def test_all_components_share_the_clock_of_the_server() -> None:
    timeline = TakeTimeline()
    assert timeline.time_us(MARKERS, 1, 1_000_000, START) == 0
    assert timeline.time_us(ANALOG, 2, 1_000_500, START + 30_000) == 500


def test_clocks_may_drift_apart_and_time_stamps_wrap_around() -> None:
    messages = [(k * PERIOD_US, round(k * PERIOD_US * 1.0005)) for k in range(100_000)]
    assert times(messages)[-1] == 99_999 * PERIOD_US
    assert times(((2**32 - 1_000_000 + time) % 2**32, time) for time in regular(300)) == regular(300)


@pytest.mark.parametrize("stamp", [0, -1, 5_000_000, -(2**63)])
def test_frozen_time_stamps_are_no_clock(stamp: int) -> None:
    assert times([(stamp, time) for time in regular(300)]) == regular(300)


@pytest.mark.parametrize("step", [-3_600_000_000, -400_000, 400_000, 3_600_000_000])
def test_a_recording_computer_whose_clock_was_set_does_not_matter(step: int) -> None:
    assert times((time, time + (step if k >= 100 else 0)) for k, time in enumerate(regular(300))) == regular(
        300
    )


@pytest.mark.parametrize("unit", [0.001, 1000, 1.5, 0.7])
def test_time_stamps_of_another_unit_are_no_clock(unit: float) -> None:
    placed = times([(round(k * PERIOD_US * unit), k * PERIOD_US) for k in range(1000)])
    assert placed[600:] == regular(400, placed[600])
    assert all(abs(time - k * PERIOD_US) <= 260_000 for k, time in enumerate(placed))


@pytest.mark.parametrize("restart", [0, 3_000_000, 2**40])
def test_after_a_restart_of_the_server_the_time_goes_on(restart: int) -> None:
    before = [(7_000_000 + time, time) for time in regular(200)]
    after = [(restart + time, 5_000_000 + time) for time in regular(200)]
    assert times(before + after) == regular(200) + regular(200, 5_000_000)


def test_the_clock_may_be_set_back_when_two_components_follow() -> None:
    timeline = TakeTimeline()
    placed = []
    for k in range(300):
        captured = START + k * PERIOD_US - (3_600_000_000 if k >= 100 else 0)
        placed.append(timeline.time_us(MARKERS, 1, k * PERIOD_US, captured))
        assert timeline.time_us(ANALOG, 2, k * PERIOD_US, captured + 100) == placed[-1]
    assert placed == regular(300)


@pytest.mark.parametrize("step", [-(10**15), -3_600_000_000, 10**15])
@pytest.mark.parametrize("restart", [-1_000_000, 3_000_000])
def test_the_clock_may_be_set_while_the_server_restarts(restart: int, step: int) -> None:
    before = [(time, time) for time in regular(200)]
    after = [(restart + time, 2_000_000 + step + time) for time in regular(200)]
    placed = times(before + after)
    assert placed[:200] == regular(200)
    assert placed[200:] == regular(200, placed[200])
    assert placed[200] - placed[199] <= PERIOD_US


def test_a_damaged_time_delays_nothing() -> None:
    messages = [(time, time) for time in regular(300)]
    messages[100] = (-(2**62), 2**62)
    placed = times(messages)
    assert placed[:100] == regular(100)
    assert placed[150:] == regular(150, placed[150])
    assert abs(placed[150] - 150 * PERIOD_US) <= 2 * PERIOD_US
