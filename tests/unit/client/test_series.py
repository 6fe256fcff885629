"""What is lost on the way to a subscriber, as the numbers of its messages show it."""

import random
from collections.abc import Iterable

import pytest

from gateway.client.series import SequenceCheck
from gateway.messages.encode import NOT_PUBLISHED, PREFIX

SESSION = 3


def message(sequence: int, session: int = SESSION, utime: int | None = None) -> bytes:
    time = 1_000_000 + 5000 * sequence if utime is None else utime
    return bytes(8) + PREFIX.pack(time, time, sequence, session, 1)


def check_of(messages: Iterable[bytes]) -> SequenceCheck:
    check = SequenceCheck()
    for each in messages:
        check.add(each)
    return check


@pytest.mark.parametrize(
    ("before", "after", "session", "expected"),
    [
        pytest.param([], range(5000, 6000), SESSION, (0, 0, 0), id="nothing is missing before the first"),
        pytest.param([*range(10, 20), *range(23, 30)], range(31, 40), SESSION, (4, 2, 0), id="gaps"),
        pytest.param(range(100), range(100, 200), SESSION + 1, (0, 0, 0), id="another session of the server"),
        pytest.param(range(500, 600), range(50), SESSION, (0, 0, 1), id="a restart of the gateway"),
        pytest.param(range(500, 600), range(7, 50), SESSION, (7, 1, 1), id="its first messages are missing"),
        pytest.param(range(10), range(20, 30), SESSION - 1, (20, 1, 1), id="a restart with higher numbers"),
        pytest.param((1, 2, 4), (3, 5, 6, 7), SESSION, (0, 0, 0), id="a late message"),
        pytest.param((5, NOT_PUBLISHED), (6, NOT_PUBLISHED, 7), SESSION, (0, 0, 0), id="without a number"),
    ],
)
def test_lost_messages_gaps_and_restarts_are_counted(
    before: Iterable[int], after: Iterable[int], session: int, expected: tuple[int, int, int]
) -> None:
    check = check_of([*map(message, before), *(message(number, session) for number in after)])
    assert (check.num_lost, check.num_gaps, check.num_restarts) == expected
    assert (check.session, check.has_two_publishers) == (session, False)


def test_a_message_that_comes_twice_is_counted() -> None:
    check = check_of(message(number) for number in (1, 2, 2, 3))
    assert (check.num_lost, check.num_repeated) == (0, 1)


@pytest.mark.parametrize("offset", [-40_000, -1, 1, 40_000])
def test_two_gateways_are_told_from_loss(offset: int) -> None:
    mine = [message(50_000 + number) for number in range(300)]
    other = [message(50_000 + offset * 5 + number, utime=17 * number) for number in range(300)]
    choice = random.Random(1)
    check = SequenceCheck()
    while mine and other:
        check.add((mine if choice.random() < 0.5 else other).pop(0))
    assert check.has_two_publishers
    assert check.num_restarts <= 1


@pytest.mark.parametrize("seed", range(20))
def test_every_loss_is_found(seed: int) -> None:
    choice = random.Random(seed)
    kept = [number for number in range(2000) if choice.random() < 0.95]
    missing = 1 + kept[-1] - kept[0] - len(kept)
    assert check_of(map(message, kept)).num_lost == missing


def test_any_numbers_are_taken() -> None:
    choice = random.Random(0)
    numbers = [0, -5, 2**63 - 1, -(2**63)]
    check_of(message(choice.choice([*numbers, choice.getrandbits(60)]), utime=0) for _ in range(1000))
