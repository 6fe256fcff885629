import random
from collections.abc import Iterable

import pytest

from gateway.messages.stamp import NOT_PUBLISHED, PREFIX
from gateway.subscriber.sequence_check import SequenceCheck

SESSION = 3


def message(sequence: int, session: int = SESSION, utime: int | None = None) -> bytes:
    time = 1_000_000 + 5000 * sequence if utime is None else utime
    return bytes(8) + PREFIX.pack(time, time, sequence, session, 1)


def check_of(messages: Iterable[bytes]) -> SequenceCheck:
    check = SequenceCheck()
    for each in messages:
        check.add(each)
    return check


def numbers(*ranges: range, session: int = SESSION) -> list[bytes]:
    return [message(number, session) for each in ranges for number in each]


def losses(check: SequenceCheck) -> tuple[int, int, int]:
    return check.num_lost, check.num_gaps, check.num_restarts


def test_numbers_before_the_first_message_are_not_missing() -> None:
    assert losses(check_of(numbers(range(5000, 6000)))) == (0, 0, 0)


def test_missing_numbers_are_counted_by_message_and_by_gap() -> None:
    assert losses(check_of(numbers(range(10, 20), range(23, 30), range(31, 40)))) == (4, 2, 0)


def test_a_reconnection_to_the_server_is_no_loss() -> None:
    messages = [*numbers(range(100)), *numbers(range(100, 200), session=SESSION + 1)]
    check = check_of(messages)
    assert losses(check) == (0, 0, 0)
    assert check.session == SESSION + 1


def test_a_restart_of_the_gateway_is_no_loss_if_its_first_message_arrives() -> None:
    assert losses(check_of(numbers(range(500, 600), range(50)))) == (0, 0, 1)


def test_first_messages_after_a_restart_can_be_missing() -> None:
    assert losses(check_of(numbers(range(500, 600), range(7, 50)))) == (7, 1, 1)


def test_a_lower_session_shows_a_restart_although_the_number_is_higher() -> None:
    messages = [*numbers(range(10)), *numbers(range(20, 30), session=SESSION - 1)]
    assert losses(check_of(messages)) == (20, 1, 1)


def test_a_message_that_comes_late_is_not_missing() -> None:
    check = check_of(message(number) for number in (1, 2, 4, 3, 5, 6, 7))
    assert losses(check) == (0, 0, 0)
    assert not check.has_two_publishers


def test_a_message_that_comes_twice_is_counted() -> None:
    check = check_of(message(number) for number in (1, 2, 2, 3))
    assert losses(check) == (0, 0, 0)
    assert check.num_repeated == 1


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


def test_an_unpublished_frame_has_no_place_in_the_numbers() -> None:
    assert losses(check_of(message(number) for number in (5, NOT_PUBLISHED, 6, NOT_PUBLISHED, 7))) == (
        0,
        0,
        0,
    )


@pytest.mark.parametrize("seed", range(20))
def test_every_loss_is_found(seed: int) -> None:
    choice = random.Random(seed)
    kept = [number for number in range(2000) if choice.random() < 0.95]
    missing = 1 + kept[-1] - kept[0] - len(kept)
    assert check_of(map(message, kept)).num_lost == missing


def test_any_numbers_are_taken() -> None:
    choice = random.Random(0)
    check_of(
        message(choice.choice([0, -5, 2**63 - 1, -(2**63), choice.getrandbits(60)]), utime=0)
        for _ in range(1000)
    )
