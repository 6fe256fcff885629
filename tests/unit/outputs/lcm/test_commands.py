"""Commands on LCM in memory: what the service gets, and what peers receive."""

import asyncio
import json

import pytest

from gateway.errors import QueryError
from gateway.messages.decode import C3D, JSON
from gateway.outputs.contract import Answer
from gateway.outputs.lcm.commands import MAX_REMEMBERED
from tests.support.errors import names
from tests.support.waiting import wait_until_async
from tests.unit.outputs.lcm.peer import Lab, command_request, with_settings

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
