"""Gaps in sequence numbers, and steps of the clock, found in arrays of any division."""

from itertools import pairwise

import numpy as np
import pytest

from gateway.takes.clock_steps import MAX_LISTED_STEPS, ClockSteps
from gateway.takes.sequence_gaps import MAX_LISTED_GAPS, SequenceGaps

SECOND_US = 1_000_000


def gaps_of(*numbers: int, utimes: list[int] | None = None, pieces: int = 1) -> SequenceGaps:
    """Return the gaps in numbers; without times, what goes back was overtaken."""
    found = SequenceGaps()
    times = [max(numbers[: place + 1]) for place in range(len(numbers))] if utimes is None else utimes
    for start in range(0, len(numbers), max(1, len(numbers) // pieces)):
        stop = start + max(1, len(numbers) // pieces)
        found.add(np.array(numbers[start:stop], np.int64), np.array(times[start:stop], np.int64))
    found.finish()
    return found


def counts(found: SequenceGaps) -> tuple[int, int, int, int, int, int]:
    """Return missing, gaps, late, repeated, restarts and implausible."""
    return (*(found.missing, found.num_gaps, found.late, found.repeated, found.restarts), found.implausible)


@pytest.mark.parametrize("pieces", [1, 3, 100])
@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ((), (0, 0, 0, 0, 0, 0)),
        ((5, 6, 7, 8), (0, 0, 0, 0, 0, 0)),
        ((5, 6, 8, 9, 20, 21), (11, 2, 0, 0, 0, 0)),
        ((0, 1, 4, 2, 3, 3, 5, 7), (1, 1, 2, 1, 0, 0)),
        ((0, 3, 1, 5), (2, 2, 1, 0, 0, 0)),
        ((0, 1_000_000), (999_999, 1, 0, 0, 0, 0)),
        ((0, 1_000_002, 1), (0, 0, 0, 0, 0, 1)),  # the message after it shows the damage
        ((0, 1_000_002), (1_000_001, 1, 0, 0, 0, 0)),  # nothing contradicts it
        ((2000, 1000, 2001), (0, 0, 0, 1, 0, 0)),  # late, though never missing
        ((2000, 999, 2001), (0, 0, 0, 0, 0, 1)),
        ((2000, 500, 501), (0, 0, 0, 0, 1, 0)),
    ],
)
def test_what_is_missing_is_told_from_what_is_late_repeated_damaged_or_restarted(
    numbers: tuple[int, ...], expected: tuple[int, ...], pieces: int
) -> None:
    """A report of losses that did not happen costs hours of search in a network."""
    assert counts(gaps_of(*numbers, pieces=pieces)) == expected


def test_after_a_restart_a_number_of_before_is_not_expected_any_more() -> None:
    """A repeated message of the new numbering must not fill a gap of the old one."""
    found = gaps_of(0, 4, 0, 1, 2, 3, 2, utimes=[0, 1, 2, 3, 4, 5, 5])
    assert counts(found) == (3, 1, 0, 1, 1, 0)


def test_the_numbers_that_may_come_late_are_the_newest_ones() -> None:
    """The memory is bounded; after a gap of 10,000 messages, a short one can still be filled."""
    assert counts(gaps_of(0, 10_001, 10_007, 10_003)) == (10_004, 2, 1, 0, 0, 0)
    assert counts(gaps_of(0, 10_010, 9_500, 5))[:4] == (10_008, 1, 1, 0)


def test_the_largest_gap_is_found_although_it_is_not_listed() -> None:
    """The list is bounded, and the worst place is the first that a user wants to see."""
    numbers = [2 * number for number in range(150)]
    found = gaps_of(*numbers, 400, 402)
    assert (len(found.gaps), found.num_gaps) == (MAX_LISTED_GAPS, 151)
    assert found.largest is not None
    assert (found.largest.missing, found.largest.utime) == (101, 400)
    filled = gaps_of(0, 3, 1, 2, 5)
    assert filled.largest is not None
    assert (filled.largest.missing, len(filled.gaps)) == (1, 1)
    assert gaps_of(0, 1).largest is None


def steps_of(delays_us: list[int], per_window: int = 4) -> ClockSteps:
    """Return the steps if the frames of each second arrive with these delays; the last is the latest one."""
    found = ClockSteps()
    for second, delay_us in enumerate(delays_us):
        stamps = np.arange(per_window, dtype=np.int64) * SECOND_US // per_window + second * SECOND_US
        utimes = stamps + delay_us
        found.add(utimes[:1], stamps[:1])
        late_us = np.arange(per_window - 1) * 900_000  # the first one of a second counts
        found.add(utimes[1:] + late_us, stamps[1:])
    found.add(np.array([], np.int64), np.array([], np.int64))
    return found


@pytest.mark.parametrize(
    ("delays_us", "expected"),
    [
        ([0] * 20, []),
        ([0] * 5 + [2 * SECOND_US] * 6, [(7, 2 * SECOND_US)]),
        ([0] * 5 + [2 * SECOND_US] * 5, []),  # the last second may not be complete
        ([0] * 5 + [2 * SECOND_US] * 4 + [0] * 5, []),  # a stall
        ([0] * 5 + [499_999] * 10, []),  # like frames that arrive late
        ([0] * 5 + [500_000] * 10, [(5, 500_000)]),
        ([0] * 5 + [-3_600 * SECOND_US] * 6, [(-3_595, -3_600 * SECOND_US)]),
        ([0] * 5 + [number * SECOND_US for number in range(1, 12)] + [0] * 9, []),  # a network that clogs
        ([0] * 5 + [2 * SECOND_US] * 6 + [0] * 6, [(7, 2 * SECOND_US), (11, -2 * SECOND_US)]),
    ],
)
def test_a_step_of_the_clock_is_told_from_a_stall(
    delays_us: list[int], expected: list[tuple[int, int]]
) -> None:
    """A clock that was set bends every time in the take; a stall only looks like it."""
    steps = steps_of(delays_us).steps
    assert [(step.utime // SECOND_US, step.step_us) for step in steps] == expected


def test_after_a_long_pause_the_clock_is_compared_anew() -> None:
    """Two clocks drift apart in a pause; a minute is the limit."""

    def steps_after(pause: int) -> int:
        found = ClockSteps()
        for second in (*range(10), *range(9 + pause, 20 + pause)):
            delay = 0 if second < 10 else 2 * SECOND_US
            stamp = np.array([second * SECOND_US], np.int64)
            found.add(stamp + delay, stamp)
        return found.num_steps

    assert [steps_after(pause) for pause in (1, 60, 61)] == [1, 1, 0]


def test_of_a_second_that_is_read_in_two_parts_the_earliest_frame_counts() -> None:
    """Frames that the network delayed must not look like a step of the clock where a batch ends."""
    steps = ClockSteps()
    for second in range(40):
        for part_us, delay_us in ((0, 0), (500_000, 5_000_000 * (second >= 20))):
            timestamp_us = 1_000_000 * second + part_us
            steps.add(np.array([10**15 + timestamp_us + delay_us]), np.array([timestamp_us]))
    assert steps.num_steps == 0


def test_listed_steps_are_bounded() -> None:
    """A clock that jumps all night must not fill the memory."""
    delays = [2 * SECOND_US * (window // 5 % 2) for window in range(5 * 104 + 1)]
    found = steps_of(delays)
    assert (len(found.steps), found.num_steps) == (MAX_LISTED_STEPS, 103)
    assert all(first.step_us == -second.step_us for first, second in pairwise(found.steps))
