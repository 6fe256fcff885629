"""When a client's packets are answered: in their order, one in each turn of the loop, and not too many."""

import asyncio

import pytest

from gateway.session.server.command_queue import MAX_COMMAND_BYTES, MAX_COMMANDS_PER_S, CommandQueue
from tests.unit.session.server.wire import COMMAND, command, packet


class Answers:
    """Answers the packets of a queue; ``given`` are those so far."""

    def __init__(self) -> None:
        self.given: list[bytes] = []
        self.num_calls = 0
        self.queue = CommandQueue(self._answer_next)

    def _answer_next(self) -> None:
        self.num_calls += 1
        if self.queue.packets and (received := self.queue.take()) is not None:
            self.given.append(received.body)


@pytest.fixture
async def answers() -> Answers:
    return Answers()


async def test_one_packet_is_answered_in_a_turn_of_the_loop_however_often_it_is_asked_for(
    answers: Answers,
) -> None:
    """Two answers in a turn would let one client delay the frames of the others."""
    first = command("first")
    answers.queue.feed(first + command("second")[:3])
    answers.queue.feed(command("second")[3:])
    answers.queue.schedule()
    answers.queue.schedule()
    assert (answers.given, answers.queue.is_scheduled) == ([], True)
    await asyncio.sleep(0)
    assert (answers.given, answers.queue.is_scheduled) == ([b"first"], False)
    answers.queue.schedule()
    await asyncio.sleep(0)
    assert answers.given == [b"first", b"second"]


async def test_a_client_that_sends_too_many_waits(answers: Answers) -> None:
    """A program in an endless loop must not use up the processor."""
    answers.queue.feed(20 * int(MAX_COMMANDS_PER_S) * command("x"))
    num_taken = 0
    while answers.queue.take() is not None:
        num_taken += 1
    assert num_taken >= MAX_COMMANDS_PER_S
    assert answers.queue.packets
    await asyncio.sleep(0.04)
    assert answers.num_calls == 0
    await asyncio.sleep(0.02)
    assert answers.num_calls == 1


@pytest.mark.parametrize("size", [7, MAX_COMMAND_BYTES + 1])
async def test_packets_before_one_that_cannot_be_read_are_answered(answers: Answers, size: int) -> None:
    """The client gets these replies before it learns why the connection is closed."""
    sizes = []
    for data in (command("first"), command("second") + size.to_bytes(4, "big") + packet(COMMAND)):
        answers.queue.feed(data)
        sizes.append(answers.queue.bad_size)
    assert sizes == [None, size]
    assert [each.body for each in answers.queue.packets] == [b"first", b"second"]
