"""Commands on LCM in memory: what the service gets, and what peers receive."""

import asyncio
import json

import pytest

from gateway.errors import QueryError
from gateway.outputs.contract import Answer
from gateway.outputs.encodings import C3D, JSON
from gateway.outputs.lcm.commands import MAX_REMEMBERED
from tests.unit.outputs.lcm.peer import Lab, command_request, request, with_settings
from tests.waiting import wait_until_async

START = ("take", "set=start", "name=walk-1")


async def test_a_command_gets_the_answer_of_the_service_as_json(lab: Lab) -> None:
    lab.send(command_request(7, *START), kind="COMMAND")
    [reply] = await lab.receive()
    assert (reply.request_id, reply.requester) == (7, "test")
    assert json.loads(reply.content) == {"name": "walk-1"}
    assert (reply.error, reply.error_code) == ("", "")
    assert lab.service.commands_received == [("lab", ("take",), {"set": "start", "name": "walk-1"})]
    assert lab.output.query_results == {"lab": {"ok": 1}}


ON_ZENOH = "ask on Zenoh (a take: rtc3d-gateway take fetch, without --lcm)"


@pytest.mark.parametrize(
    ("command", "text"),
    [
        *(((name,), "accepted on LCM: recording, take") for name in ("c3d", "", "take/", "x" * 3000)),
        *((("take", option), "accepted: NAME=VALUE") for option in ("start", "", "ä")),
        (("take", "read=walk-1", "offset=0"), ON_ZENOH),
    ],
)
async def test_what_is_no_command_on_lcm_is_refused(lab: Lab, command: tuple[str, ...], text: str) -> None:
    lab.send(command_request(7, *command), kind="COMMAND")
    [reply] = await lab.receive()
    assert reply.error_code == "bad-request"
    assert text in reply.error
    assert len(reply.error) < 200
    assert lab.service.commands_received == []


@pytest.mark.parametrize(
    ("answer", "code", "text"),
    [
        (QueryError("remote control is off", code="refused"), "refused", "remote control is off"),
        (Answer(b"\0" * 100, C3D), "bad-request", "is no JSON; ask on Zenoh"),
    ],
)
async def test_an_error_of_the_service_and_an_answer_without_json_are_errors(
    lab: Lab, answer: Answer | Exception, code: str, text: str
) -> None:
    lab.service.answers["take"] = answer
    lab.send(command_request(7, "take"), kind="COMMAND")
    [reply] = await lab.receive()
    assert (reply.content, reply.error_code) == ("", code)
    assert text in reply.error


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


async def test_another_message_on_the_channel_of_commands_is_malformed(lab: Lab) -> None:
    for data in (b"", request(1), command_request(1)[:-1], command_request(1, requester="x" * 129)):
        lab.send(data, kind="COMMAND")
    assert lab.lost("lab") == {"malformed request": (4, 0)}
    assert lab.replies == []
