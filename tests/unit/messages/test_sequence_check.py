"""What the numbers of messages show: losses, restarts, late and damaged messages, and a second publisher."""

import random
from collections.abc import Iterable, Sequence

import numpy as np
import pytest

from gateway.messages.sequence_check import SequenceCheck


def check_of(*numbers: int, utimes: Sequence[int] | None = None, pieces: int | None = None) -> SequenceCheck:
    """Check numbers one by one, or in arrays. Without times, what goes back was overtaken."""
    times = [max(numbers[: place + 1]) for place in range(len(numbers))] if utimes is None else utimes
    check = SequenceCheck(max_listed=100)
    if pieces is None:
        for number, time in zip(numbers, times, strict=True):
            check.add(number, time)
        return check
    size = max(1, len(numbers) // pieces)
    for start in range(0, len(numbers), size):
        place = slice(start, start + size)
        check.add_all(np.array(numbers[place], np.int64), np.array(times[place], np.int64))
    return check


def counts(check: SequenceCheck) -> tuple[int, int, int, int, int, int]:
    """Return lost, gaps, late, repeated, restarts and implausible."""
    lost = (check.num_lost, check.num_gaps, check.num_late, check.num_repeated)
    return (*lost, check.num_restarts, check.num_implausible)


@pytest.mark.parametrize("pieces", [None, 1, 3])
@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ((), (0, 0, 0, 0, 0, 0)),
        ((5, 6, 7, 8), (0, 0, 0, 0, 0, 0)),
        ((5, 6, 8, 9, 20, 21), (11, 2, 0, 0, 0, 0)),
        ((0, 1, 4, 2, 3, 3, 5, 7), (1, 1, 2, 1, 0, 0)),
        ((0, 3, 1, 5), (2, 2, 1, 0, 0, 0)),
        ((1, 2, 4, 3, 5, 6), (0, 0, 1, 0, 0, 0)),
        ((0, 1_000_000), (999_999, 1, 0, 0, 0, 0)),
        ((0, 1_000_002, 1), (0, 0, 0, 0, 0, 1)),  # the message after it shows the damage
        ((0, 1_000_002), (1_000_001, 1, 0, 0, 0, 0)),  # nothing contradicts it
        ((0, 1, 2**62, 3), (1, 1, 0, 0, 0, 1)),  # the message beside the damaged one is missing
        ((2000, 500, 2001), (0, 0, 0, 0, 0, 1)),
        ((2000, 500, 501), (0, 0, 0, 0, 1, 0)),
        ((2000, 500, 500), (0, 0, 0, 1, 1, 0)),
        ((*range(7, 200), *range(300, 400)), (100, 1, 0, 0, 0, 0)),
        ((*range(200), 300, *range(200, 300)), (0, 0, 100, 0, 0, 0)),
    ],
)
def test_what_is_missing_is_told_from_what_is_late_repeated_damaged_or_restarted(
    numbers: tuple[int, ...], expected: tuple[int, ...], pieces: int | None
) -> None:
    """A report of losses that did not happen costs hours of search in a network."""
    assert counts(check_of(*numbers, pieces=pieces)) == expected


@pytest.mark.parametrize("copied", [[99], [80, 81, 82], [69, 68]])
@pytest.mark.parametrize("pieces", [None, 1])
def test_copies_of_recent_messages_are_repeated(copied: list[int], pieces: int | None) -> None:
    """UDP may deliver a message twice; a copy has the number and the time of the first."""
    numbers = [*range(100), *copied, 100, 101]
    assert counts(check_of(*numbers, utimes=numbers, pieces=pieces)) == (0, 0, 0, len(copied), 0, 0)


def test_after_a_restart_a_number_of_before_is_not_expected_any_more() -> None:
    """A repeated message of the new numbering must not fill a gap of the old one."""
    check = check_of(0, 4, 0, 1, 2, 3, 2, utimes=[0, 1, 2, 3, 4, 5, 4])
    assert counts(check) == (3, 1, 0, 1, 1, 0)


def test_the_numbers_that_may_come_late_are_the_newest_ones() -> None:
    """The memory is bounded; after a gap of 10,000 messages, a short one can still be filled."""
    assert counts(check_of(0, 10_001, 10_007, 10_003)) == (10_004, 2, 1, 0, 0, 0)
    assert counts(check_of(0, 10_010, 10_011, 9_500, 5))[:5] == (10_008, 1, 1, 0, 1)


def test_the_largest_gap_is_found_although_it_is_not_listed() -> None:
    """The list is bounded, and the worst place is the first that a user wants to see."""
    numbers = [2 * number for number in range(150)]
    check = check_of(*numbers, 400, 402)
    assert (len(check.gaps), check.num_gaps) == (100, 151)
    assert check.largest is not None
    assert (check.largest.missing, check.largest.utime) == (101, 400)
    filled = check_of(0, 3, 1, 2, 5)
    assert filled.largest is not None
    assert (filled.largest.missing, len(filled.gaps)) == (1, 1)
    assert check_of(0, 1).largest is None
    assert check_of(0, 2_000_000, 1, 3).largest == check_of(0, 2_000_000, 1, 3).gaps[0]


@pytest.mark.parametrize(
    ("before", "after", "session", "expected"),
    [
        pytest.param([], range(5000, 6000), 3, (0, 0, 0), id="nothing is missing before the first"),
        pytest.param(range(100), range(100, 200), 4, (0, 0, 0), id="another session of the server"),
        pytest.param(range(500, 600), range(50), 3, (0, 0, 1), id="a restart of the gateway"),
        pytest.param(range(500, 600), range(7, 50), 3, (7, 1, 1), id="its first messages are missing"),
        pytest.param(range(10), range(20, 30), 2, (20, 1, 1), id="a restart with higher numbers"),
    ],
)
def test_a_subscriber_misses_the_first_messages_after_a_restart(
    before: Iterable[int], after: Iterable[int], session: int, expected: tuple[int, int, int]
) -> None:
    """It was there when the gateway started again; a recording may have been put together of two."""
    check = SequenceCheck(counts_first=True)
    for place, (number, in_session) in enumerate([*((n, 3) for n in before), *((n, session) for n in after)]):
        check.add(number, place, in_session)
    assert (check.num_lost, check.num_gaps, check.num_restarts) == expected
    assert (check.session, check.has_two_publishers) == (session, False)


@pytest.mark.parametrize("clock_us", [-(10**9), -2000, 2000, 10**9])
@pytest.mark.parametrize("offset", [-200_000, -5, 0, 5, 200_000])
def test_two_gateways_are_told_from_loss(offset: int, clock_us: int) -> None:
    """Their clocks may differ."""
    mine = [(50_000 + number, 5000 * number) for number in range(300)]
    other = [(50_000 + offset + number, 5000 * number + clock_us) for number in range(300)]
    choice = random.Random(1)
    check = SequenceCheck(counts_first=True)
    while mine and other:
        check.add(*(mine if choice.random() < 0.5 else other).pop(0))
    assert check.has_two_publishers
    assert check.num_restarts <= 1


@pytest.mark.parametrize("seed", range(20))
def test_every_loss_is_found(seed: int) -> None:
    choice = random.Random(seed)
    kept = [number for number in range(2000) if choice.random() < 0.95]
    missing = 1 + kept[-1] - kept[0] - len(kept)
    assert check_of(*kept).num_lost == missing


@pytest.mark.parametrize("seed", range(20))
def test_a_network_that_reorders_and_copies_loses_nothing(seed: int) -> None:
    choice = random.Random(seed)
    sent = [
        (number + choice.random() * 5 * (number > 0), number) for number in range(1000) if number % 50 < 40
    ]
    sent += [(place + 3, number) for place, number in sent if choice.random() < 0.1]
    numbers = [number for _, number in sorted(sent)]
    check = check_of(*numbers, utimes=numbers)
    assert (check.num_lost, check.num_restarts, check.num_repeated) == (190, 0, len(sent) - 800)
    assert not check.has_two_publishers


def test_any_numbers_are_taken() -> None:
    choice = random.Random(0)
    numbers = [0, -5, 2**63 - 1, -(2**63)]
    check_of(*(choice.choice([*numbers, choice.getrandbits(60)]) for _ in range(1000)), utimes=[0] * 1000)


@pytest.mark.parametrize("number", [2, 5])
def test_nothing_is_missing_up_to_a_number_that_was_damaged(number: int) -> None:
    """A recording would be called incomplete by 2^62 messages that never existed."""
    check = check_of(0, 1, 2**62)
    check.correct(number)
    check.add(number + 1, 4)
    assert (check.num_lost, check.num_gaps, check.num_implausible) == (number - 2, number > 2, 1)
    check.add(2, 3)
    assert (check.num_lost, check.num_gaps) == (max(number - 3, 0), number > 3)


def test_a_late_message_takes_no_memory_for_all_numbers_up_to_a_damaged_one() -> None:
    """They can be 2^62, and the subscriber would end with MemoryError, or without memory."""
    check = check_of(5, 7, 2**62, 6, 7, 8, 10, 9, utimes=(0, 2, 3, 1, 2, 4, 6, 5))
    assert check.num_late == 1


def test_two_runs_of_one_message_each_are_told_apart() -> None:
    """Events are rare: a gateway may restart after its first one."""
    check = check_of(0, 0, 2, utimes=(1, 2, 3))
    assert (check.num_restarts, check.num_lost) == (1, 1)
