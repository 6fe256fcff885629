"""Replies on LCM in memory: long ones, and messages of the history that follow."""

import itertools
import threading

import pytest

from gateway.errors import OutputError
from gateway.messages.decode import LCM_MESSAGES
from gateway.messages.history import pack_messages
from gateway.outputs.contract import Answer
from gateway.outputs.lcm import replies
from tests.support.waiting import wait_until_async
from tests.unit.outputs.lcm.peer import XML, Lab, command_request, request, with_settings

MESSAGES = [bytes([number]) * 1000 for number in range(40)]
REFILL = command_request(7, "history", "key=3d", "from=0")


def let_messages_be_asked_for(lab: Lab) -> list[bytes]:
    """Let the service have messages of 3D; return those that are sent again."""
    lab.service.answers["3d"] = Answer(pack_messages(MESSAGES), LCM_MESSAGES, {"from": 0})
    sent: list[bytes] = []
    lab.lcm.subscribe("MOCAP_LAB_3D_REFILL", lambda _, data: sent.append(data)).set_queue_capacity(1000)
    return sent


async def test_a_long_reply_is_sent_by_a_thread(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would keep the frames of all sources waiting."""
    monkeypatch.setattr(replies, "LONG_REPLY_BYTES", len(XML) - 1)
    may_send = threading.Event()
    lab.requests.replies.long_sender.submit(may_send.wait)
    lab.send(request(1))
    await wait_until_async(lambda: lab.output.query_results == {"lab": {"ok": 1}})
    lab.deliver()
    assert lab.replies == []
    may_send.set()
    await lab.receive()


async def test_a_refill_without_room_for_its_reply_is_an_error_and_counted(lab: Lab) -> None:
    """Its asker got nothing, not even a reason, and asked until it gave up. The next one has room again."""
    sent = let_messages_be_asked_for(lab)
    may_send = threading.Event()
    lab.requests.replies.long_sender.submit(may_send.wait)
    while lab.requests.replies.long_sender.offer(lambda: None):
        pass
    lab.send(REFILL, kind="COMMAND")
    [reply] = await lab.receive()
    assert (reply.request_id, reply.error_code) == (7, "busy")
    assert lab.lost("lab") == {"reply beyond the queue": (1, 0)}
    may_send.set()
    await wait_until_async(lambda: lab.requests.replies.long_sender.offer(lambda: None))
    lab.send(REFILL, kind="COMMAND")
    assert [each.error_code for each in await lab.receive(2)] == ["busy", ""]

    def is_complete() -> bool:
        lab.deliver()
        return len(sent) == len(MESSAGES)

    await wait_until_async(is_complete)
    assert sent == MESSAGES


async def test_a_long_reply_without_room_is_an_error_and_counted(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replies, "LONG_REPLY_BYTES", len(XML) - 1)
    monkeypatch.setattr(lab.requests.replies.long_sender, "offer", lambda *_: False)
    lab.send(request(1))
    assert [each.error_code for each in await lab.receive()] == ["busy"]
    assert lab.lost("lab") == {"reply beyond the queue": (1, 0)}


class FakeTime:
    """A clock that goes on while the sender sleeps, and by 0.1 ms with each look at it."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.sent: list[tuple[float, int]] = []

    def monotonic(self) -> float:
        self.now_s += 1e-4
        return self.now_s

    def sleep(self, duration_s: float) -> None:
        assert duration_s > 0
        self.now_s += duration_s


@pytest.mark.interpreted
@with_settings(max_reply_bytes_per_s=10_000)
async def test_messages_are_sent_again_no_faster_than_replies_may_be(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise, they fill the buffers of everybody who receives on LCM. The reply comes first."""
    clock = FakeTime()
    monkeypatch.setattr(replies, "time", clock)
    order: list[tuple[str, float]] = []
    monkeypatch.setattr(
        lab.requests.replies.sender, "send", lambda channel, _: order.append((channel, clock.now_s))
    )
    lab.requests.replies.is_refilling = True
    lab.requests.replies._refill("lab", lambda: order.append(("reply", clock.now_s)), "again", MESSAGES)
    assert [channel for channel, _ in order] == ["reply", *["again"] * len(MESSAGES)]
    times_s = [sent_s for _, sent_s in order[1:]]
    steps_s = [after - before for before, after in itertools.pairwise(times_s)]
    assert steps_s == pytest.approx([0.1] * len(steps_s), rel=0.01)
    assert not lab.requests.replies.is_refilling


@pytest.mark.interpreted
async def test_a_refill_that_cannot_be_sent_is_counted_and_ends(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without this, no subscriber could be refilled any more."""

    def refuse(_channel: str, _data: bytes) -> None:
        raise OutputError("no multicast", cause="send failed")

    monkeypatch.setattr(lab.requests.replies.sender, "send", refuse)
    lab.requests.replies.is_refilling = True
    lab.requests.replies._refill("lab", lambda: None, "again", MESSAGES)
    assert not lab.requests.replies.is_refilling
    assert lab.lost("lab") == {"send failed": (1, 0)}


async def test_one_subscriber_is_refilled_at_a_time(lab: Lab) -> None:
    """Everybody receives what is sent again, so two at once would be twice the load for all."""
    let_messages_be_asked_for(lab)
    may_send = threading.Event()
    lab.requests.replies.long_sender.submit(may_send.wait)
    lab.send(REFILL, kind="COMMAND")
    await wait_until_async(lambda: lab.requests.replies.is_refilling)
    lab.send(command_request(8, "history", "key=3d", "from=0"), kind="COMMAND")
    assert [(each.request_id, each.error_code) for each in await lab.receive()] == [(8, "busy")]
    may_send.set()
    await lab.receive(2)
    await wait_until_async(lambda: not lab.requests.replies.is_refilling)
