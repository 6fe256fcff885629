"""Asking a gateway on LCM for missed messages, and for anything else, with a gateway of the test."""

import contextlib
import json
from collections.abc import Iterator, Sequence

import pytest
import rtc3d

from gateway.client import lcm_refill, lcm_requester
from gateway.client.history_requests import HistoryAnswer
from gateway.client.lcm_refill import LcmRefill
from gateway.client.lcm_requester import LcmRequester
from gateway.client.lcm_transport import LcmTransport
from gateway.client.transport import Query
from gateway.messages.decode import decode
from gateway.messages.encode import PREFIX
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.settings import lcm_queries_url
from gateway.outputs.lcm.subscriber import LcmSubscriber
from tests.support.networks import lcm_url
from tests.support.waiting import wait_until

pytestmark = pytest.mark.netns

SENT_AGAIN = "MOCAP_LAB_3D_REFILL"


def message(number: int) -> bytes:
    return bytes(8) + PREFIX.pack(1000 + number, 0, number, 1, 0) + bytes(16)


class Gateway:
    """Says that it has messages 0 to 2, and sends those in ``sent`` again."""

    def __init__(self) -> None:
        url = lcm_url()
        self.sent: Sequence[int] = (0, 1, 2)
        self._lcm = open_lcm(url)
        self._subscriber = LcmSubscriber(open_lcm(url), "MOCAP_LAB_COMMAND_REQUEST", self._reply)
        self._requester = LcmRequester(url, "MOCAP")
        self._refill = LcmRefill(url, "MOCAP", self._requester)

    def _reply(self, _channel: str, data: bytes) -> None:
        request, reply = decode(data), rtc3d.command_reply_t()
        reply.request_id, reply.requester = request.request_id, request.requester
        facts = {"from": 0, "to": 2, "newest": 9, "channel": SENT_AGAIN, "num_messages": 3}
        reply.content = json.dumps(facts)
        self._lcm.publish("MOCAP_LAB_COMMAND_REPLY", reply.encode())
        for number in self.sent:
            self._lcm.publish(SENT_AGAIN, message(number))

    def ask(self) -> HistoryAnswer:
        return self._refill.ask("MOCAP_LAB", {"key": "3d", "from": "0"}, 60.0)

    def close(self) -> None:
        self._refill.close()
        self._requester.close()
        self._subscriber.close()


@pytest.fixture
def gateway() -> Iterator[Gateway]:
    with contextlib.closing(Gateway()) as gateway:
        yield gateway


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a busy machine take its time for what is not lost."""
    monkeypatch.setattr(lcm_refill, "_QUIET_S", 20.0)


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("sent", [(0, 1, 2), (2, 0, 1, 1), (0, 1, 7, 2)])
def test_what_is_sent_again_is_the_answer_in_the_order_of_its_numbers(
    gateway: Gateway, sent: Sequence[int]
) -> None:
    """Datagrams may come twice or in another order, and others may have asked for more."""
    gateway.sent = sent
    expected = [message(number) for number in range(3)]
    assert gateway.ask() == HistoryAnswer(expected, 0, 2, 9, is_whole=True)


def test_an_answer_of_which_something_is_lost_again_is_not_whole(gateway: Gateway) -> None:
    """Otherwise, the rest would count as gone from the gateway, and nobody would ask for it again."""
    gateway.sent = (0, 2)
    assert not gateway.ask().is_whole


@pytest.mark.usefixtures("patient")
def test_a_long_recording_can_be_refilled_again_and_again(
    gateway: Gateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The limit is for one request: what earlier ones have brought must not use it up."""
    monkeypatch.setattr(lcm_refill, "_MAX_BYTES", 4 * len(message(0)))
    assert [gateway.ask().is_whole for _ in range(3)] == [True, True, True]


def test_what_is_kept_of_one_answer_is_bounded(gateway: Gateway, monkeypatch: pytest.MonkeyPatch) -> None:
    """Anybody can send on these channels."""
    monkeypatch.setattr(lcm_refill, "_MAX_BYTES", 2 * len(message(0)))
    answer = gateway.ask()
    assert (len(answer.messages) <= 2, answer.is_whole) == (True, False)


def test_the_oldest_of_too_many_requests_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """A source that never replies must not take up memory, and no other source's reply must be missed."""
    monkeypatch.setattr(lcm_requester, "_MAX_WAITING", 2)
    url, received = lcm_url(), list[int]()
    publisher = open_lcm(url)
    with contextlib.closing(LcmRequester(url, "MOCAP")) as requester:
        requests = [
            requester.prepare(rtc3d.command_request_t(), lambda reply: received.append(reply.request_id))
            for _ in range(3)
        ]
        for request in requests:
            reply = rtc3d.command_reply_t()
            reply.request_id, reply.requester = request.request_id, request.requester
            publisher.publish("MOCAP_LAB_COMMAND_REPLY", reply.encode())
        wait_until(lambda: len(received) == 2)
    assert received == [1, 2]


def test_a_question_that_is_refused_at_first_has_the_answer_to_its_repetition() -> None:
    """A busy gateway refuses for a moment, and the question is sent again until its time is up."""
    url, num_requests = lcm_url(), 0
    queries = lcm_queries_url(url)
    publisher = open_lcm(queries)

    def reply_to(_channel: str, data: bytes) -> None:
        nonlocal num_requests
        num_requests += 1
        request, reply = decode(data), rtc3d.command_reply_t()
        reply.request_id, reply.requester = request.request_id, request.requester
        if num_requests == 1:
            reply.error, reply.error_code = "later", "busy"
        else:
            reply.content = "{}"
        publisher.publish("MOCAP_LAB_COMMAND_REPLY", reply.encode())

    subscriber = LcmSubscriber(open_lcm(queries), "MOCAP_LAB_COMMAND_REQUEST", reply_to)
    transport = LcmTransport(url, queries, "MOCAP")
    with contextlib.closing(subscriber), contextlib.closing(transport):
        replies = transport.ask(Query("take", "takes"), "lab", 60.0)
    assert [reply.content for reply in replies.received] == [b"{}"]
    assert replies.problems == []
