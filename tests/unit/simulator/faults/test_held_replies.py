import asyncio

from gateway.simulator.faults.held_replies import HeldReplies
from gateway.simulator.faults.outgoing import Reply
from tests.unit.rtc3d_server.wire import COMMAND, DATA, NO_DATA, packet

FIRST, SECOND = packet(COMMAND, b"first"), packet(COMMAND, b"second")
NEVER_S = 600.0


def test_a_reply_waits_for_its_number_of_frames() -> None:
    sent: list[bytes] = []
    held = HeldReplies(sent.append)
    held.hold(Reply(FIRST, after_frames=2))
    held.packet_sent(packet(DATA))
    held.packet_sent(SECOND)
    assert (sent, held.waiting_bytes) == ([], len(FIRST))

    held.packet_sent(packet(DATA))

    assert (sent, held.waiting_bytes) == ([FIRST], 0)


def test_no_data_ends_the_wait_for_frames() -> None:
    sent: list[bytes] = []
    held = HeldReplies(sent.append)
    held.hold(Reply(FIRST, after_frames=9))
    held.packet_sent(packet(NO_DATA))

    assert sent == [FIRST]


def test_a_frame_that_a_released_reply_causes_releases_no_reply_twice() -> None:
    sent: list[bytes] = []

    def send(reply: bytes) -> None:
        sent.append(reply)
        held.packet_sent(packet(DATA))

    held = HeldReplies(send)
    held.hold(Reply(FIRST, after_frames=1))
    held.hold(Reply(SECOND, after_frames=1))
    held.packet_sent(packet(DATA))

    assert sent == [FIRST, SECOND]


async def test_flush_sends_all_replies_in_order_and_cancels_their_timers() -> None:
    sent: list[bytes] = []
    held = HeldReplies(sent.append)
    held.hold(Reply(FIRST, delay_s=NEVER_S))
    held.hold(Reply(SECOND, after_frames=1))
    held.flush()

    assert (sent, held.waiting_bytes) == ([FIRST, SECOND], 0)


async def test_a_reply_is_sent_after_its_delay_unless_it_is_discarded() -> None:
    sent: asyncio.Queue[bytes] = asyncio.Queue()
    held, discarded = HeldReplies(sent.put_nowait), HeldReplies(sent.put_nowait)
    discarded.hold(Reply(FIRST, delay_s=0.001))
    held.hold(Reply(SECOND, delay_s=0.002))
    discarded.clear()

    assert await asyncio.wait_for(sent.get(), 20) == SECOND
    assert sent.empty()
