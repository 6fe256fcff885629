import pytest

from gateway.replay.timeline import Jump, ReplayTimeline

START = 1_700_000_000_000_000
HOUR = 3_600_000_000


class Placed:
    """The positions that a timeline gives to messages, and its jumps."""

    def __init__(self, max_gap_s: float = 10.0) -> None:
        self.jumps: list[Jump] = []
        self._timeline = ReplayTimeline(max_gap_s, self.jumps.append)

    def place(self, *utimes: int, source: str = "lab") -> list[int]:
        return [self._timeline.place(source, START + utime) for utime in utimes]


def test_positions_count_from_the_first_message() -> None:
    placed = Placed()
    assert placed.place(0, 5000, 5000, 1_000_000) == [0, 5000, 5000, 1_000_000]
    assert placed.jumps == []


def test_messages_out_of_order_follow_at_once_and_delay_no_others() -> None:
    placed = Placed()
    assert placed.place(0, 20_000, 5000, 19_999, 25_000) == [0, 20_000, 20_000, 20_000, 25_000]
    assert placed.jumps == []


@pytest.mark.parametrize("step", [-3 * HOUR, -1_000_000, 3 * HOUR])
def test_the_replay_goes_on_at_once_where_somebody_has_set_the_clock(step: int) -> None:
    placed = Placed()
    assert placed.place(0, 5000, 10_000 + step, 15_000 + step) == [0, 5000, 5000, 10_000]
    assert placed.jumps == [Jump(5000, "lab", step + 5000, True)]


def test_the_clock_may_be_set_back_and_forth() -> None:
    placed = Placed()
    assert placed.place(0, 5000, HOUR, 10_000, 15_000) == [0, 5000, 5000, 5000, 10_000]
    assert [jump.jump_us for jump in placed.jumps] == [HOUR - 5000, 10_000 - HOUR]


def test_a_gap_is_waited_for_and_reported() -> None:
    placed = Placed()
    assert placed.place(0, 8_000_000, 8_005_000) == [0, 8_000_000, 8_005_000]
    assert placed.jumps == [Jump(0, "lab", 8_000_000, False)]


def test_long_gaps_are_skipped_if_that_is_wanted() -> None:
    placed = Placed(max_gap_s=2 * HOUR / 1e6)
    assert placed.place(0, HOUR) == [0, HOUR]
    placed = Placed(max_gap_s=0)
    assert placed.place(0, 3_000_000, 3_005_000) == [0, 0, 5000]
    assert placed.jumps == [Jump(0, "lab", 3_000_000, True)]


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
