"""Requests on LCM in memory: what peers receive, and what the output counts."""

import asyncio
import threading

import pytest

from gateway.errors import QueryError
from gateway.outputs.contract import ServerParameters
from gateway.outputs.lcm import requests
from gateway.outputs.lcm.receiver import MAX_REQUEST_BYTES, LcmReceiver
from gateway.outputs.lcm.requests import MAX_REQUESTER_BYTES, LcmRequests
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
    lab.requests.replies.long_sender.offer(is_sent.set)
    await wait_until_async(is_sent.is_set)
    lab.deliver()
    assert [reply.error_code for reply in lab.replies].count("rate") == 2


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
