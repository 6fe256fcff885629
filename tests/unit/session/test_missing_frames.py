"""Gaps in the server's frame numbers: counted where they are proven, and never by mistake."""

import random
from collections.abc import Iterable

import pytest

from gateway.session.missing_frames import MissingFrames

PERIOD_US = 2500


def num_missing(numbers: Iterable[int], period_us: float = PERIOD_US) -> int:
    """Return how many frames are missing among these numbers; the time stamps follow the numbers."""
    observer = MissingFrames()
    return sum(observer.observe(number, round(number * period_us)) for number in numbers)


def test_a_gap_in_a_regular_numbering_is_counted_once() -> None:
    assert num_missing([*range(300), *range(350, 1000)]) == 50
    assert num_missing([*range(300), *range(350, 1000), *range(1007, 1100)]) == 57


@pytest.mark.parametrize("divisor", [2, 4, 7])
def test_steps_of_a_divisor_are_regular_and_their_gaps_count_in_steps(divisor: int) -> None:
    numbers = [number * divisor for number in (*range(300), *range(310, 400))]
    assert num_missing(numbers, PERIOD_US / divisor) == 10


def test_two_gaps_close_together_both_count() -> None:
    assert num_missing([*range(300), *range(305, 308), *range(310, 400)]) == 7


def test_jitter_of_the_time_stamps_does_not_matter() -> None:
    observer, rng = MissingFrames(), random.Random(1)
    numbers = [*range(300), *range(310, 400)]
    assert sum(observer.observe(each, each * PERIOD_US + rng.randint(-500, 500)) for each in numbers) == 10


@pytest.mark.parametrize(
    "numbers",
    [
        pytest.param([7] * 1000, id="constant"),
        pytest.param([*range(150), *range(160, 250)], id="a gap before the numbering is proven"),
        pytest.param([*range(300), *range(310, 325)], id="a gap that nothing regular follows"),
        pytest.param([*range(300), *range(100, 400)], id="a restart"),
        pytest.param([*range(300), *range(300, 900, 2), *range(900, 1200)], id="half the rate for a while"),
        pytest.param([*range(300), *range(300, 400, 2), *range(400, 700)], id="half the rate for a moment"),
        pytest.param([number * 10 // 9 for number in range(2000)], id="nine of ten frames from the start"),
        pytest.param(
            [*range(300), *(300 + number * 10 // 9 for number in range(2000)), *range(2523, 3000)],
            id="nine of ten frames later",
        ),
        pytest.param([number ^ 1 for number in range(1000)], id="pairs the wrong way round"),
    ],
)
def test_what_may_have_another_reason_is_not_counted(numbers: list[int]) -> None:
    assert num_missing(numbers) == 0


def test_a_jump_of_the_numbers_without_one_of_the_time_is_not_counted() -> None:
    observer = MissingFrames()
    numbers = [*range(300), *range(400, 700)]
    timestamps = (index * PERIOD_US for index in range(len(numbers)))
    assert sum(map(observer.observe, numbers, timestamps)) == 0


def test_a_pause_that_the_caller_knows_of_is_not_counted() -> None:
    observer = MissingFrames()
    for number in range(300):
        assert observer.observe(number, number * PERIOD_US) == 0
    observer.interrupt()
    for number in range(1000, 1300):
        assert observer.observe(number, number * PERIOD_US) == 0
    assert sum(observer.observe(number, number * PERIOD_US) for number in range(1305, 1400)) == 5


@pytest.mark.parametrize(("num_steps", "missing"), [(19, 0), (20, 10)])
def test_twenty_regular_steps_confirm_a_gap(num_steps: int, missing: int) -> None:
    """Fewer may be chance; waiting for more would report the loss later."""
    assert num_missing([*range(300), *range(310, 311 + num_steps)]) == missing


@pytest.mark.parametrize(("num_gaps", "missing"), [(3, 6), (21, 42), (22, 0)])
def test_gaps_count_if_the_first_is_confirmed_within_200_frames(num_gaps: int, missing: int) -> None:
    """Gaps that come back again and again, here after every ten frames, are another rate and no loss."""
    numbers = list(range(300))
    for _ in range(num_gaps):
        numbers += range(numbers[-1] + 3, numbers[-1] + 13)
    assert num_missing([*numbers, *range(numbers[-1] + 1, numbers[-1] + 31)]) == missing
