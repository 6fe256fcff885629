"""Where a message of a take is in its replay, the places from which a seek reads, and the pace."""

import random
from pathlib import Path

import pytest

from gateway.takes.files.reader import FIRST_PLACE, TakeReader
from gateway.tools.replay.pace import Lateness, Pace
from gateway.tools.replay.play_list import STEP_US, SeekIndex, SeekPoint, Selection, play_list
from gateway.tools.replay.timeline import Jump, ReplayTimeline, time_text
from tests.support.takes import markers, parameters, write_take

START = 1_700_000_000_000_000
HOUR = 3_600_000_000
XML = b"<Parameters><The_3D><Markers>1</Markers></The_3D></Parameters>"


class Placed:
    """The positions that a timeline gives to messages, and its jumps."""

    def __init__(self, max_gap_s: float = 10.0) -> None:
        self.jumps: list[Jump] = []
        self._timeline = ReplayTimeline(max_gap_s, self.jumps.append)

    def place(self, *utimes: int, source: str = "lab", key: str = "3d") -> list[int]:
        return [self._timeline.place(source, key, START + utime) for utime in utimes]


def set_clock(step: int) -> tuple[list[int], list[int], list[Jump]]:
    """Return what is expected where somebody sets the clock: the replay goes on at once."""
    return (
        [0, 5000, 10_000 + step, 15_000 + step],
        [0, 5000, 5000, 10_000],
        [Jump(5000, "lab", step + 5000, True)],
    )


BACK_AND_FORTH = [Jump(5000, "lab", HOUR - 5000, True), Jump(5000, "lab", 10_000 - HOUR, True)]


@pytest.mark.parametrize(
    ("utimes", "positions", "jumps"),
    [
        pytest.param([0, 5000, 5000, 10**6], [0, 5000, 5000, 10**6], [], id="from the first message"),
        pytest.param([0, 20_000, 5000, 19_999, 25_000], [0, *[20_000] * 3, 25_000], [], id="out of order"),
        *(pytest.param(*set_clock(step), id=f"step of {step}") for step in (-3 * HOUR, -1_000_000, 3 * HOUR)),
        pytest.param(
            [0, 5000, HOUR, 10_000, 15_000], [0, *[5000] * 3, 10_000], BACK_AND_FORTH, id="there and back"
        ),
        pytest.param(
            [0, 8_000_000], [0, 8_000_000], [Jump(0, "lab", 8_000_000, False)], id="a gap is waited for"
        ),
    ],
)
def test_messages_are_placed_by_time(utimes: list[int], positions: list[int], jumps: list[Jump]) -> None:
    placed = Placed()
    assert placed.place(*utimes) == positions
    assert placed.jumps == jumps


def test_messages_that_a_recorder_has_requested_late_move_no_clock() -> None:
    placed = Placed()
    assert placed.place(0, key="event") == [0]
    assert placed.place(5000, 2_000_000) == [5000, 2_000_000]
    assert placed.place(500_000, 1_000_000, key="event") == [2_000_000] * 2
    assert placed.place(2_005_000) == [2_005_000]
    assert placed.jumps == []
    assert placed.place(999_999, key="event") == [2_005_000]
    assert [jump.jump_us for jump in placed.jumps] == [999_999 - 2_005_000]


@pytest.mark.parametrize(
    ("max_gap_s", "gap", "after", "is_skipped"),
    [(2 * HOUR / 1e6, HOUR, HOUR, False), (0, 3_000_000, 0, True)],
)
def test_long_gaps_are_skipped_if_wanted(max_gap_s: float, gap: int, after: int, is_skipped: bool) -> None:
    placed = Placed(max_gap_s)
    assert placed.place(0, gap, gap + 5000) == [0, after, after + 5000]
    assert placed.jumps == [Jump(0, "lab", gap, is_skipped)]


def test_a_pause_of_one_source_is_no_gap_while_another_goes_on() -> None:
    placed = Placed()
    placed.place(0, source="stage")
    placed.place(*range(0, 60_000_000, 1_000_000))
    assert placed.place(60_000_000, source="stage") == [60_000_000]
    assert placed.jumps == []


def test_a_gap_of_two_sources_is_reported_once() -> None:
    placed = Placed()
    placed.place(0, source="stage")
    placed.place(1000)
    assert placed.place(HOUR) == [1000]
    assert placed.place(HOUR + 2000, source="stage") == [3000]
    assert placed.place(HOUR + 4000) == [5000]
    assert len(placed.jumps) == 1


def test_a_step_of_one_clock_does_not_move_the_other_source() -> None:
    placed = Placed()
    placed.place(0, source="stage")
    placed.place(1000)
    assert placed.place(HOUR) == [1000]
    assert placed.place(2000, source="stage") == [2000]
    assert placed.place(HOUR + 2000) == [3000]
    assert placed.place(4000, source="stage") == [4000]
    assert len(placed.jumps) == 1


@pytest.mark.parametrize("difference", [-HOUR, -1_000_000])
def test_sources_may_have_clocks_that_differ(difference: int) -> None:
    placed = Placed()
    assert placed.place(0, 10_000) == [0, 10_000]
    assert placed.place(20_000 + difference, 30_000 + difference, source="stage") == [10_000, 20_000]
    assert placed.place(25_000) == [25_000]
    assert placed.jumps == []


# Seeking -------------------------------------------------------------------------------------


def point(position_us: int) -> SeekPoint:
    timeline = ReplayTimeline()
    timeline.position_us = position_us
    return SeekPoint(FIRST_PLACE, timeline, {})


@pytest.mark.parametrize(
    ("position_us", "expected"), [(0, None), (1, 0), (3_000_000, 0), (3_000_001, 1), (9_000_000, 1)]
)
def test_a_seek_begins_strictly_before_its_target(position_us: int, expected: int | None) -> None:
    """Several messages have the same position: the place may be after the first of them."""
    index, points = SeekIndex(), [point(0), point(3_000_000)]
    for each in points:
        index.add(each)
    assert index.before(position_us) == (None if expected is None else points[expected])
    assert index.next_us == 3_000_000 + STEP_US
    assert SeekIndex().before(10**9) is None


def test_a_pass_adds_a_place_every_two_seconds_and_a_second_pass_none(tmp_path: Path) -> None:
    """A place for each message would take as much memory as the take."""
    positions: list[int] = []

    class NotingIndex(SeekIndex):
        def add(self, point: SeekPoint) -> None:
            positions.append(point.timeline.position_us)
            super().add(point)

    messages = [parameters(XML), *(markers(1, number) for number in range(1001))]
    reader, index = TakeReader(write_take(tmp_path / "take.lcmlog", messages)), NotingIndex()
    for _ in range(2):
        assert len([*play_list(reader, Selection(), ReplayTimeline(), 0, index)]) == 1002
    assert positions == [*range(0, 10_000_000, STEP_US)]


# The pace ------------------------------------------------------------------------------------


def test_positions_are_due_on_an_absolute_schedule_that_a_pause_moves() -> None:
    now_s = 100.0
    pace = Pace(2.0, lambda: now_s)
    pace.start(10_000_000)
    assert pace.due_s(10_000_000) == pytest.approx(100.0)
    now_s = 105.0  # however late a message was, the next one is due as planned
    assert pace.due_s(14_000_000) == pytest.approx(102.0)
    pace.shift(7.0)
    assert pace.due_s(3_610_000_000) == pytest.approx(1907.0)


def test_quantiles_of_the_lateness_are_right_within_2_percent_and_have_no_limits() -> None:
    choice, late = random.Random(1), Lateness()
    assert late.quantile_s(0.99) == 0.0
    values = sorted(choice.lognormvariate(-8, 2) for _ in range(20_000))
    for value in values:
        late.add(value)
    for fraction in (0.5, 0.9, 0.99, 0.999):
        assert late.quantile_s(fraction) == pytest.approx(values[int(fraction * len(values)) - 1], rel=0.03)
    assert late.max_s == late.quantile_s(1.0) == values[-1]
    extreme = Lateness()
    for value in (0.0, 1e-9, 1e9):
        extreme.add(value)
    assert (extreme.quantile_s(0.1) <= 1.1e-6, extreme.max_s) == (True, 1e9)


@pytest.mark.parametrize(
    ("duration_us", "text"),
    [
        (0, "0:00:00.0"),
        (62_590_000, "0:01:02.5"),
        (3_599_999_999, "0:59:59.9"),
        (7_262_500_000, "2:01:02.5"),
        (-2_000_000, "-0:00:02.0"),
    ],
)
def test_times_have_hours_minutes_seconds_and_tenths(duration_us: int, text: str) -> None:
    assert time_text(duration_us) == text
