"""Recordings on the server: by packet or by command, followed by the outputs."""

import asyncio
import json
from typing import Any

import pytest

from gateway.errors import QueryError, ReplyTimeoutError, ServerError
from gateway.rtc3d.packets import Packet, PacketType
from tests.unit.queries.fake_source import FakeSource

OK = Packet(PacketType.COMMAND, b"OK-Recording")
START, STOP = "Recording Start,file=walk-1.c3d", "Recording Stop"


async def record(source: FakeSource, set_: str, name: str = "") -> Any:
    return json.loads((await source.answer("recording", name, set=set_)).payload)


async def test_without_a_name_the_packet_is_sent() -> None:
    source = FakeSource()
    assert await record(source, "start") == {"source": "lab", "sent": "start", "take": ""}
    assert await record(source, "stop") == {"source": "lab", "sent": "stop"}
    assert source.recorded == [True, False]
    assert source.server.commands == []
    assert source.followed == [(True, ""), (False, "")]


async def test_with_a_name_the_commands_are_sent() -> None:
    source = FakeSource()
    source.server.replies = {START: OK, STOP: OK}
    assert await record(source, "start", "walk-1") == {
        "source": "lab",
        "sent": "start",
        "name": "walk-1",
        "is_named": True,
        "take": "walk-1",
    }
    await record(source, "stop")
    assert source.server.commands == [START, STOP]
    assert source.recorded == []
    assert source.followed == [(True, "walk-1"), (False, "")]


@pytest.mark.parametrize("problem", [ServerError("err-unknown command"), ReplyTimeoutError("no answer")])
async def test_a_server_that_does_not_accept_the_command_gets_the_packet(problem: Exception) -> None:
    source = FakeSource()
    source.server.replies = {START: problem}
    assert (await record(source, "start", "walk-1"))["is_named"] is False
    await record(source, "stop")
    assert source.server.commands == [START]
    assert source.recorded == [True, False]


async def test_a_recording_whose_stop_is_refused_is_stopped_by_the_packet() -> None:
    source = FakeSource()
    source.server.replies = {START: OK, STOP: ServerError("err-unknown command")}
    await record(source, "start", "walk-1")
    await record(source, "stop")
    assert source.recorded == [False]


async def test_without_a_connection_nothing_is_recorded_or_followed() -> None:
    source = FakeSource()
    source.server.is_connected = False
    with pytest.raises(QueryError, match="has no connection yet") as caught:
        await record(source, "start", "walk-1")
    assert caught.value.code == "no-connection"
    assert source.followed == []


async def test_a_recording_that_cannot_start_is_followed_to_its_end() -> None:
    source = FakeSource()
    recording = asyncio.ensure_future(record(source, "start", "walk-1"))
    await source.server.wait_for_commands(1)
    source.server.is_connected = False
    source.server.unanswered.popleft().set_exception(ServerError("err-unknown command"))
    with pytest.raises(QueryError, match="has no connection yet"):
        await recording
    assert source.followed == [(True, "walk-1"), (False, "")]


async def test_a_disk_that_does_not_respond_does_not_delay_the_server() -> None:
    """The take begins before the recording, so that nothing is missing; its file may come later."""
    source = FakeSource()
    source.disk.clear()
    recording = asyncio.ensure_future(record(source, "start"))
    for _ in range(10):
        await asyncio.sleep(0)
    assert (source.followed, source.recorded, recording.done()) == ([(True, "")], [True], False)
    source.disk.set()
    assert (await recording)["take"] == ""


async def test_start_and_stop_are_carried_out_in_their_order() -> None:
    source = FakeSource()
    start = asyncio.ensure_future(record(source, "start", "walk-1"))
    await source.server.wait_for_commands(1)
    stop = asyncio.ensure_future(record(source, "stop"))
    for _ in range(5):
        await asyncio.sleep(0)
    assert source.server.commands == [START]
    source.server.unanswered.popleft().set_result(OK)
    source.server.replies = {STOP: OK}
    await asyncio.gather(start, stop)
    assert (source.server.commands, source.recorded) == ([START, STOP], [])
    assert source.followed == [(True, "walk-1"), (False, "")]


async def test_a_name_beyond_ascii_is_an_error() -> None:
    source = FakeSource()
    with pytest.raises(QueryError, match="ASCII letters only"):
        await record(source, "start", "gång")
    assert source.followed == []


async def test_an_option_is_needed() -> None:
    with pytest.raises(QueryError, match="accepted: set=start;name=NAME, set=stop"):
        await FakeSource().answer("recording")
