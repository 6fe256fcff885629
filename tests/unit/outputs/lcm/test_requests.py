"""Requests on LCM in memory: what peers receive, and what the output counts.

Commands on LCM in memory: what the service gets, and what peers receive.
"""

import asyncio
import itertools
import json
import threading

import pytest

from gateway.errors import OutputError, QueryError
from gateway.messages.decode import C3D, JSON, LCM_MESSAGES
from gateway.messages.history import pack_messages
from gateway.outputs import other_gateways
from gateway.outputs.contract import Answer, ServerParameters
from gateway.outputs.lcm import requests
from gateway.outputs.lcm.receiver import LcmReceiver
from gateway.outputs.lcm.requests import MAX_REMEMBERED, MAX_REQUEST_BYTES, MAX_REQUESTER_BYTES, LcmRequests
from gateway.outputs.lcm.sender import LcmSender
from gateway.outputs.lcm.settings import LcmSettings
from gateway.runtime.token_bucket import TokenBucket
from tests.support.clocks import Clock
from tests.support.errors import names
from tests.support.waiting import wait_until_async
from tests.unit.outputs.lcm.peer import XML, Lab, command_request, request, with_settings


async def test_a_reply_has_the_answer_of_the_service(lab: Lab) -> None:
    lab.send(request(7, "3d", "force", fresh=True))
    [reply] = await lab.receive()
    assert (reply.request_id, reply.requester) == (7, "test")
    assert (reply.xml, reply.age_s, reply.error, reply.error_code) == (XML.decode(), 2.5, "", "")
    assert reply.parameters_version == 4
    assert lab.service.received == [("lab", ["3d", "force"], True)]
    assert lab.service.log_fields == [{"source": "lab"}]
    assert lab.output.query_results == {"lab": {"ok": 1}}


async def test_sources_are_served_whenever_they_are_announced(lab: Lab) -> None:
    lab.output.announce("hall")
    lab.output.announce("hall")
    lab.send(request(1), "HALL")
    await lab.receive()
    lab.send(request(2), "LAB")
    await lab.receive(2)
    assert [reply.request_id for reply in lab.replies] == [1, 2]
    assert lab.service.received == [("hall", [], False), ("lab", [], False)]


async def test_a_source_that_is_no_longer_served_gets_no_reply(lab: Lab) -> None:
    lab.service.sources.clear()
    lab.send(request(1))
    await asyncio.sleep(0)  # the event loop rejects the request
    lab.service.sources.add("lab")
    lab.send(request(2))
    assert [reply.request_id for reply in await lab.receive()] == [2]


async def test_requests_beyond_the_limit_are_dropped_and_counted_by_source(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(requests, "MAX_PENDING", 2)
    lab = Lab()
    lab.open()
    lab.output.announce("hall")
    lab.service.may_answer.clear()
    lab.service.sources.discard("hall")
    for _ in range(3):
        lab.send(request(0), "HALL")  # refused requests must not keep their places
        await asyncio.sleep(0)
    assert lab.lost("hall") == {}
    for number in range(4):
        lab.send(request(number))
        await asyncio.sleep(0)
    assert lab.lost("lab") == {"request beyond the queue": (2, 0)}
    lab.service.may_answer.set()
    assert [reply.request_id for reply in await lab.receive(2)] == [0, 1]
    lab.send(request(5))
    await lab.receive(3)
    assert lab.lost("lab") == {"request beyond the queue": (2, 0)}
    await lab.output.stop_queries()


@with_settings(max_queries_per_source_per_s=1.0)
async def test_requests_beyond_the_rate_get_an_error_and_are_counted(lab: Lab) -> None:
    for number in range(8):
        lab.send(request(number))
    replies = await lab.receive(8)
    refused = [reply for reply in replies if reply.error_code == "rate"]
    assert refused
    assert len(refused) < 8
    assert {reply.requester for reply in refused} == {"test"}
    assert names(refused[0].error, "lcm.max_queries_per_source_per_s")
    assert lab.lost("lab") == {"request beyond the rate": (len(refused), 0)}
    assert lab.output.query_results == {"lab": {"ok": 8 - len(refused), "rate": len(refused)}}


@with_settings(max_queries_per_source_per_s=1.0)
async def test_a_flood_of_requests_is_not_a_flood_of_errors(lab: Lab) -> None:
    is_sent = threading.Event()
    lab.requests.admission._refusals = TokenBucket(2.0, monotonic=Clock())
    for number in range(8):
        lab.send(request(number))
    lab.requests.long_sender.offer(is_sent.set)
    await wait_until_async(is_sent.is_set)
    lab.deliver()
    assert [reply.error_code for reply in lab.replies].count("rate") == 2


async def test_a_long_reply_is_sent_by_a_thread(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would keep the frames of all sources waiting."""
    monkeypatch.setattr(requests, "LONG_REPLY_BYTES", len(XML) - 1)
    may_send = threading.Event()
    lab.requests.long_sender.submit(may_send.wait)
    lab.send(request(1))
    await wait_until_async(lambda: lab.output.query_results == {"lab": {"ok": 1}})
    lab.deliver()
    assert lab.replies == []
    may_send.set()
    await lab.receive()


@with_settings(max_reply_bytes_per_s=1024)
async def test_replies_beyond_the_bytes_of_a_second_are_errors(lab: Lab) -> None:
    lab.service.reply = ServerParameters(b"x" * 4000, 3, 4)
    lab.send(request(1))
    lab.send(request(2))
    assert [reply.error_code for reply in await lab.receive(2)] == ["", "rate"]


async def test_malformed_requests_and_those_beyond_the_limits_are_counted_by_source(lab: Lab) -> None:
    lab.send(request(1, requester="ä" * (MAX_REQUESTER_BYTES // 2)))
    lab.send(request(2) + bytes(MAX_REQUEST_BYTES - len(request(2))))
    await lab.receive(2)
    lab.output.announce("hall")
    assert lab.lost("lab") == {}
    lab.send(request(3, requester="ä" * (MAX_REQUESTER_BYTES // 2) + "x"))
    lab.send(request(4) + bytes(MAX_REQUEST_BYTES + 1 - len(request(4))))
    for data in (b"", request(5)[:-1], bytes(8) + request(6)[8:]):
        lab.send(data)
    assert (lab.lost("lab"), lab.lost("hall")) == ({"malformed request": (5, 0)}, {})
    assert lab.requests.admission.num_pending == 0


async def test_after_the_end_of_queries_no_request_is_answered() -> None:
    lab = Lab()
    lab.open()
    lab.service.may_answer.clear()
    lab.send(request(1))
    await wait_until_async(lambda: lab.service.received)
    await lab.output.stop_queries()
    lab.service.may_answer.set()
    lab.send(request(2))
    await asyncio.sleep(0)
    lab.deliver()
    assert lab.replies == []
    assert len(lab.service.received) == 1


async def test_a_request_after_the_end_of_the_event_loop_is_ignored(lab: Lab) -> None:
    loop = asyncio.new_event_loop()
    loop.close()
    sender = LcmSender("memq://", lab.lcm, lambda: None)
    settings, service = LcmSettings(url="memq://"), lab.service
    late = LcmRequests(settings, service, loop, sender, lab.lcm, {})  # type: ignore[arg-type]  # it has the methods that LCM calls
    late.add("lab")
    lab.send(request())
    await late.close()


@pytest.mark.parametrize(
    ("reply", "error", "code", "request_values"),
    [
        (QueryError("the server refuses", code="refused"), "the server refuses", "refused", []),
        (
            ZeroDivisionError("of the test"),
            "ZeroDivisionError('of the test')",
            "defect",
            [7, "'test'"],
        ),
    ],
)
async def test_an_error_is_the_reply_and_a_defect_is_logged(
    lab: Lab,
    reply: Exception,
    error: str,
    code: str,
    request_values: list[object],
    caplog: pytest.LogCaptureFixture,
) -> None:
    lab.service.reply = reply
    lab.send(request(7))
    [received] = await lab.receive()
    assert (received.request_id, received.requester, received.xml) == (7, "test", "")
    assert received.error_code == code
    assert received.error.endswith(error)
    assert lab.output.query_results == {"lab": {code: 1}}
    assert len(caplog.records) == bool(request_values)
    assert all(record.exc_info and names(record.message, "lab", *request_values) for record in caplog.records)


def test_messages_on_other_channels_leave_room_for_requests() -> None:
    """On udpm://, the gateway's own messages arrive, too: they must not delay the replies."""
    receiver = LcmReceiver("udpm://", "MOCAP", None, lambda: None)
    receiver._received = bucket = TokenBucket(100.0, monotonic=Clock(0.0))
    requests: list[bytes] = []
    receiver.add("MOCAP_LAB_COMMAND_REQUEST", requests.append)
    for _ in range(100):
        receiver._handle("MOCAP_LAB_3D", b"message")
    assert bucket.left == pytest.approx(95.0)
    receiver._handle("MOCAP_LAB_COMMAND_REQUEST", b"request")
    assert bucket.left == pytest.approx(94.0)
    assert requests == [b"request"]


START = ("take", "set=start", "name=walk-1")


async def test_a_command_gets_the_answer_of_the_service_as_json(lab: Lab) -> None:
    lab.send(command_request(7, *START), kind="COMMAND")
    [reply] = await lab.receive()
    assert (reply.request_id, reply.requester) == (7, "test")
    assert json.loads(reply.content) == {"name": "walk-1"}
    assert (reply.error, reply.error_code) == ("", "")
    assert lab.service.commands_received == [("lab", ("take",), {"set": "start", "name": "walk-1"})]
    assert lab.output.query_results == {"lab": {"ok": 1}}


@pytest.mark.parametrize(
    ("command", "value"),
    [
        *(((name,), "history, recording, take") for name in ("c3d", "", "take/", "x" * 3000)),
        *((("take", option), "NAME=VALUE") for option in ("start", "", "ä")),
        (("take", "read=walk-1", "offset=0"), "rtc3d-gateway take fetch"),
    ],
)
async def test_what_is_no_command_on_lcm_is_refused(lab: Lab, command: tuple[str, ...], value: str) -> None:
    lab.send(command_request(7, *command), kind="COMMAND")
    [reply] = await lab.receive()
    assert reply.error_code == "bad-request"
    assert names(reply.error, value)
    assert len(reply.error) < 200
    assert lab.service.commands_received == []


@pytest.mark.parametrize(
    ("answer", "code", "value"),
    [
        (QueryError("is off", code="refused"), "refused", "is off"),
        (Answer(b"\0" * 100, C3D), "bad-request", "Zenoh"),
    ],
)
async def test_an_error_of_the_service_and_an_answer_without_json_are_errors(
    lab: Lab, answer: Answer | Exception, code: str, value: str
) -> None:
    lab.service.answers["take"] = answer
    lab.send(command_request(7, "take"), kind="COMMAND")
    [reply] = await lab.receive()
    assert (reply.content, reply.error_code) == ("", code)
    assert names(reply.error, value)


async def test_a_repeated_command_is_carried_out_once(lab: Lab) -> None:
    for _ in range(3):
        lab.send(command_request(7, *START), kind="COMMAND")
    replies = await lab.receive(3)
    assert {reply.content for reply in replies} == {'{"name":"walk-1"}'}
    assert len(lab.service.commands_received) == 1
    lab.send(command_request(8, *START), kind="COMMAND")
    lab.send(command_request(7, *START, requester="another"), kind="COMMAND")
    await lab.receive(5)
    assert len(lab.service.commands_received) == 3


async def test_a_command_that_is_in_progress_is_not_started_again(lab: Lab) -> None:
    lab.service.may_answer.clear()
    lab.send(command_request(7, *START), kind="COMMAND")
    await wait_until_async(lambda: lab.service.commands_received)
    lab.send(command_request(7, *START), kind="COMMAND")
    await asyncio.sleep(0)
    lab.service.may_answer.set()
    await lab.receive(2)
    assert len(lab.service.commands_received) == 1


async def test_a_command_that_failed_can_be_tried_again(lab: Lab) -> None:
    lab.service.answers["take"] = QueryError("the disk is full", code="refused")
    lab.send(command_request(7, *START), kind="COMMAND")
    await lab.receive()
    lab.service.answers["take"] = Answer(b"{}", JSON)
    lab.send(command_request(7, *START), kind="COMMAND")
    assert (await lab.receive(2))[1].content == "{}"


async def test_a_command_that_changes_nothing_is_asked_each_time(lab: Lab) -> None:
    for _ in range(2):
        lab.send(command_request(7, "take"), kind="COMMAND")
    await lab.receive(2)
    assert len(lab.service.commands_received) == 2


@with_settings(max_queries_per_source_per_s=1000.0, max_queries_per_s=1000.0)
async def test_only_the_newest_commands_are_remembered(lab: Lab) -> None:
    for number in range(MAX_REMEMBERED + 1):
        lab.send(command_request(number, *START), kind="COMMAND")
        await lab.receive(number + 1)
    lab.send(command_request(MAX_REMEMBERED, *START), kind="COMMAND")
    await lab.receive(MAX_REMEMBERED + 2)
    assert len(lab.service.commands_received) == MAX_REMEMBERED + 1
    lab.send(command_request(0, *START), kind="COMMAND")
    await lab.receive(MAX_REMEMBERED + 3)
    assert len(lab.service.commands_received) == MAX_REMEMBERED + 2


@with_settings(max_queries_per_source_per_s=1.0)
async def test_commands_and_requests_for_parameters_share_their_limits(lab: Lab) -> None:
    for number in range(4):
        lab.send(request(number))
    lab.send(command_request(5, "take"), kind="COMMAND")
    replies = await lab.receive(5)
    assert [reply.error_code for reply in replies if reply.request_id == 5] == ["rate"]
    assert lab.lost("lab")["request beyond the rate"][0] >= 2


@with_settings(max_queries_per_source_per_s=1.0)
async def test_a_stop_is_carried_out_whatever_the_rate(lab: Lab) -> None:
    """A take or a recording must not go on because of a flood of requests."""
    for number in range(8):
        lab.send(request(number))
    lab.send(command_request(8, "take", "set=stop"), kind="COMMAND")
    await lab.receive(9)
    assert len(lab.service.commands_received) == 1


async def test_another_message_on_the_channel_of_commands_is_malformed(lab: Lab) -> None:
    for data in (b"", request(1), command_request(1)[:-1], command_request(1, requester="x" * 129)):
        lab.send(data, kind="COMMAND")
    assert lab.lost("lab") == {"malformed request": (4, 0)}
    assert lab.replies == []


# Messages of the history ---------------------------------------------------------------------

MESSAGES = [bytes([number]) * 1000 for number in range(40)]
REFILL = command_request(7, "history", "key=3d", "from=0")


def let_messages_be_asked_for(lab: Lab) -> list[bytes]:
    """Let the service have messages of 3D; return those that are sent again."""
    lab.service.answers["3d"] = Answer(pack_messages(MESSAGES), LCM_MESSAGES, {"from": 0})
    sent: list[bytes] = []
    lab.lcm.subscribe("MOCAP_LAB_3D_REFILL", lambda _, data: sent.append(data)).set_queue_capacity(1000)
    return sent


async def test_a_refill_without_room_for_its_reply_is_an_error_and_counted(lab: Lab) -> None:
    """Its asker got nothing, not even a reason, and asked until it gave up. The next one has room again."""
    sent = let_messages_be_asked_for(lab)
    may_send = threading.Event()
    lab.requests.long_sender.submit(may_send.wait)
    while lab.requests.long_sender.offer(lambda: None):
        pass
    lab.send(REFILL, kind="COMMAND")
    [reply] = await lab.receive()
    assert (reply.request_id, reply.error_code) == (7, "busy")
    assert lab.lost("lab") == {"reply beyond the queue": (1, 0)}
    may_send.set()
    await wait_until_async(lambda: lab.requests.long_sender.offer(lambda: None))
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
    monkeypatch.setattr(requests, "LONG_REPLY_BYTES", len(XML) - 1)
    monkeypatch.setattr(lab.requests.long_sender, "offer", lambda *_: False)
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
    monkeypatch.setattr(requests, "time", clock)
    order: list[tuple[str, float]] = []
    monkeypatch.setattr(lab.requests._sender, "send", lambda channel, _: order.append((channel, clock.now_s)))
    lab.requests._is_refilling = True
    lab.requests._refill("lab", lambda: order.append(("reply", clock.now_s)), "again", MESSAGES)
    assert [channel for channel, _ in order] == ["reply", *["again"] * len(MESSAGES)]
    times_s = [sent_s for _, sent_s in order[1:]]
    steps_s = [after - before for before, after in itertools.pairwise(times_s)]
    assert steps_s == pytest.approx([0.1] * len(steps_s), rel=0.01)
    assert not lab.requests._is_refilling


@pytest.mark.interpreted
async def test_a_refill_that_cannot_be_sent_is_counted_and_ends(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without this, no subscriber could be refilled any more."""

    def refuse(_channel: str, _data: bytes) -> None:
        raise OutputError("no multicast", cause="send failed")

    monkeypatch.setattr(lab.requests._sender, "send", refuse)
    lab.requests._is_refilling = True
    lab.requests._refill("lab", lambda: None, "again", MESSAGES)
    assert not lab.requests._is_refilling
    assert lab.lost("lab") == {"send failed": (1, 0)}


async def test_one_subscriber_is_refilled_at_a_time(lab: Lab) -> None:
    """Everybody receives what is sent again, so two at once would be twice the load for all."""
    let_messages_be_asked_for(lab)
    may_send = threading.Event()
    lab.requests.long_sender.submit(may_send.wait)
    lab.send(REFILL, kind="COMMAND")
    await wait_until_async(lambda: lab.requests._is_refilling)
    lab.send(command_request(8, "history", "key=3d", "from=0"), kind="COMMAND")
    assert [(each.request_id, each.error_code) for each in await lab.receive()] == [(8, "busy")]
    may_send.set()
    await lab.receive(2)
    await wait_until_async(lambda: not lab.requests._is_refilling)


# Other gateways ------------------------------------------------------------------------------


async def test_gateways_with_a_source_of_one_name_notice_each_other(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gateway shows itself on the URL of requests. It receives that, too, and is no other one."""
    monkeypatch.setattr(other_gateways, "HOLD_S", 0.0)
    shown: list[bytes] = []
    lab.lcm.subscribe("MOCAP_LAB_GATEWAY", lambda _, data: shown.append(data))
    for _ in range(3):
        lab.output.maintain()
    lab.deliver()
    assert len(shown) == 1
    assert lab.output.warnings() == []
    for data in (b"", bytes(8), shown[0][:-1], shown[0] + bytes(MAX_REQUEST_BYTES)):
        lab.lcm.publish("MOCAP_LAB_GATEWAY", data)
    lab.lcm.publish("MOCAP_HALL_GATEWAY", command_request(0, "", requester="another"))
    lab.deliver()
    assert lab.output.warnings() == []
    lab.lcm.publish("MOCAP_LAB_GATEWAY", command_request(0, "", requester="another"))
    lab.deliver()
    assert len(lab.output.warnings()) == 1
    lab.output.withdraw("lab")
    assert lab.output.warnings() == []


@with_settings(queries=False)
async def test_a_gateway_that_receives_nothing_shows_itself_to_nobody(lab: Lab) -> None:
    """Its messages would be the only ones on the URL of requests."""
    shown: list[bytes] = []
    lab.lcm.subscribe("MOCAP_LAB_GATEWAY", lambda _, data: shown.append(data))
    lab.output.maintain()
    lab.deliver()
    assert shown == []
