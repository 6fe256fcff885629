"""Recordings on the server: by packet or by command, followed by the outputs."""

import asyncio
import contextlib
import itertools
import json
import re
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import ClosedError, QueryError, ReplyTimeoutError, ServerError
from gateway.queries.server_requests import STOPS_PER_S, ServerRequests
from gateway.rtc3d.commands import SendCurrentFrame, SendParameters
from gateway.rtc3d.packets import Packet, PacketType
from tests.support.clocks import run_in_virtual_time
from tests.support.errors import names, raises
from tests.unit.queries.fake_source import CM, MM, FakeSource


async def test_equal_requests_share_a_reply_and_different_ones_wait_for_each_other() -> None:
    source = FakeSource()
    tasks = [asyncio.create_task(source.parameters(fresh=True)) for _ in range(5)]
    tasks += [asyncio.create_task(source.parameters("6d", fresh=True)) for _ in range(5)]
    await source.server.wait_for_commands(1)
    await asyncio.sleep(0)
    assert source.server.commands == ["SendParameters"]  # one at a time
    source.server.answer(MM)
    await source.server.wait_for_commands(2)
    source.server.answer(CM)
    results = await asyncio.gather(*tasks)
    assert [result.xml for result in results] == [MM] * 5 + [CM] * 5
    assert source.server.commands == ["SendParameters", "SendParameters 6D"]
    assert len({id(result) for result in results}) == 2  # each reply is parsed once


async def test_cancelling_one_caller_does_not_cancel_a_shared_request() -> None:
    source = FakeSource()
    cancelled, other = (asyncio.create_task(source.parameters()) for _ in range(2))
    await source.server.wait_for_commands(1)
    cancelled.cancel()
    source.server.answer(MM)
    assert (await other).xml == MM
    with contextlib.suppress(asyncio.CancelledError):
        await cancelled


async def test_the_fallback_is_sent_if_the_command_is_refused_and_its_error_raised() -> None:
    source = FakeSource()
    source.server.replies = {"SendParameters 3D": ServerError("err-what?"), "SendParameters": b"<a/>"}
    requests = ServerRequests(source.queries.settings, lambda: source.streams)
    packet = await requests.send(SendParameters(("3d",)), fallback=SendParameters())
    assert packet.body == b"<a/>"
    assert source.server.commands == ["SendParameters 3D", "SendParameters"]
    source.server.replies = {"SendCurrentFrame 3D": ServerError("a"), "SendCurrentFrame": ServerError("b")}
    [component, _] = source.streams[0].components
    with raises(QueryError, "SendCurrentFrame", "b", code="refused"):
        await requests.send(SendCurrentFrame((component,)), fallback=SendCurrentFrame())


@pytest.mark.parametrize(
    ("reply", "code", "values"),
    [
        (ReplyTimeoutError("192.0.2.1:3020 did not answer"), "timeout", ["192.0.2.1:3020"]),
        (None, "timeout", ["0.05 s", 1]),
        (ClosedError("closed"), "no-connection", ["closed"]),
    ],
    ids=["the server is silent", "the query may wait no longer", "the connection is lost"],
)
async def test_a_command_without_a_reply_is_an_error_and_the_next_one_is_sent(
    reply: Exception | None, code: str, values: list[object]
) -> None:
    source = FakeSource(query_timeout_s=0.05)
    if reply is not None:
        source.server.replies["SendParameters"] = reply
    error = await source.parameters_error()
    assert error.code == code
    assert names(str(error), "lab", *values)
    source.server.replies["SendParameters"] = MM
    assert (await source.parameters()).xml == MM


async def test_losing_the_connection_while_waiting_for_another_request_is_an_error() -> None:
    source = FakeSource()
    first = asyncio.create_task(source.parameters())
    await source.server.wait_for_commands(1)
    second = asyncio.create_task(source.queries._requests.send(SendCurrentFrame()))
    source.server.is_connected = False
    source.server.answer(MM)
    await first
    with pytest.raises(QueryError) as caught:
        await second
    assert caught.value.code == "no-connection"
    assert source.server.commands == ["SendParameters"]


async def test_without_a_connection_the_error_has_the_address_or_reason_age_and_remedy() -> None:
    source = FakeSource(two_streams=True)
    source.server.is_connected = False
    error = await source.parameters_error()
    assert error.code == "no-connection"
    assert names(str(error), "lab", "192.0.2.1:3020")
    source.status.record_error("connection refused by 192.0.2.1:3020; is it on?")
    source.status.last_error_s -= 300
    source.second_status.record_error("an older error")
    source.second_status.last_error_s -= 400
    problem, _, remedy = str(await source.parameters_error(stale_ok=True)).partition("; ")
    assert names(problem, "'lab'", "refused by 192.0.2.1:3020")
    assert re.search(r" 3..\.. s", problem)
    assert remedy == "is it on?"


OK = Packet(PacketType.COMMAND, b"OK-Recording")
START, STOP = "Recording Start,file=walk-1", "Recording Stop"


async def record(source: FakeSource, set_: str, name: str = "", options: str = "") -> Any:
    return json.loads((await source.answer("recording", name, set=set_, options=options)).payload)


async def test_without_a_name_the_packet_is_sent(source: FakeSource) -> None:
    assert await record(source, "start") == {"source": "lab", "sent": "start", "take": ""}
    assert await record(source, "stop") == {"source": "lab", "sent": "stop"}
    assert source.recorded == [True, False]
    assert source.server.commands == []
    assert source.followed == [(True, ""), (False, "")]


async def test_with_a_name_the_commands_are_sent(source: FakeSource) -> None:
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
async def test_a_server_that_does_not_accept_the_command_gets_the_packet(
    source: FakeSource, problem: Exception
) -> None:
    source.server.replies = {START: problem}
    assert (await record(source, "start", "walk-1"))["is_named"] is False
    await record(source, "stop")
    assert source.server.commands == [START]
    assert source.recorded == [True, False]


@pytest.mark.parametrize(
    ("name", "options", "sent", "take"),
    [
        ("take1.tsv", "", ",file=take1.tsv", "take1"),
        ("walk-1.c3d", "", ",file=walk-1.c3d", "walk-1"),
        ("v1.2", "", ",file=v1.2", "v1.2"),
        ("walk 1", "duration=5", ",file=walk 1,duration=5", "walk 1"),
        ("", "duration=5,durationunits=seconds", ",duration=5,durationunits=seconds", ""),
        ("", ",duration=5,FILE = C:\\my takes\\run.tsv ,x=1", None, "run"),
        ("", ' file="a, b"', None, "a"),
        ("", ",file=../a?b*.c3d", None, "a_b_"),
        ("", ",file=.c3d", None, ""),
    ],
)
async def test_the_server_gets_names_and_options_unchanged(
    source: FakeSource, name: str, options: str, sent: str | None, take: str
) -> None:
    """Field note 26. The take that follows is named after the file, without what no take can have."""
    source.server.replies = {(start := f"Recording Start{sent or options}"): OK}
    assert (await record(source, "start", name, options))["sent"] == "start"
    assert source.server.commands == [start]
    assert (source.followed, source.recorded) == ([(True, take)], [])


async def test_the_peer_gets_the_name_that_the_server_uses(source: FakeSource) -> None:
    reply = "OK-Recording Start,File=walk-1_002.tsv"
    source.server.replies = {START: Packet(PacketType.COMMAND, reply.encode())}
    answer = await source.answer("recording", "walk-1", set="start")
    assert json.loads(answer.payload).items() >= {"name": "walk-1_002.tsv", "is_named": True}.items()
    assert answer.attachment == {"reply": reply}


async def test_a_recording_with_options_is_not_started_without_them(source: FakeSource) -> None:
    """A recording without end is not what the peer asked for. What the server ignores may have started."""
    start = "Recording Start,duration=5"
    source.server.replies = {start: ServerError("err-unknown command"), STOP: OK}
    with pytest.raises(QueryError, match="err-unknown command"):
        await record(source, "start", options="duration=5")
    assert (source.server.commands, source.recorded) == ([start], [])
    assert source.followed == [(True, ""), (False, "")]
    source.server.replies[start] = ReplyTimeoutError("no answer")
    with raises(QueryError, code="timeout"):
        await record(source, "start", options="duration=5")
    await record(source, "stop")
    assert (source.server.commands[-1], source.recorded) == (STOP, [])


@pytest.mark.parametrize(
    ("name", "options", "value"),
    [
        ("", ",file=a\nBye", "options"),
        ("", ",file=" + 500 * "x", 500),
        ("", ",file=gång", "ASCII"),
        ("gång", "", "ASCII"),
        ("walk", "duration=5,file=run", "file="),
    ],
)
async def test_names_and_options_that_no_command_can_have_are_refused(
    source: FakeSource, name: str, options: str, value: object
) -> None:
    with raises(QueryError, value, code="bad-request"):
        await record(source, "start", name, options)
    assert (source.server.commands, source.followed) == ([], [])


@pytest.mark.parametrize(
    ("duration", "end_s"),
    [
        ("5,DurationUnits=seconds", 6),
        ("2,durationunits=minutes", 121),
        ("5", 6),
        ("5,durationunits=frames", None),
    ],
)
def test_takes_follow_a_recording_for_its_duration(duration: str, end_s: float | None) -> None:
    """The server says nothing when it is over. A recording that starts meanwhile has its own end."""

    async def follow() -> None:
        source = FakeSource()
        source.server.replies = {f"Recording Start,duration={duration}": OK, START: OK}
        for _ in range(2):
            await record(source, "start", options=f"duration={duration}")
            await asyncio.sleep(1)
        await asyncio.sleep((end_s or 1000) - 1.01)
        assert source.followed == [(True, "")] * 2
        await asyncio.sleep(0.02)
        assert source.followed[2:] == ([] if end_s is None else [(False, "")])
        await record(source, "start", options=f"duration={duration}")
        await record(source, "start", "walk-1")
        await asyncio.sleep(1000)
        assert source.followed[-1] == (True, "walk-1")

    run_in_virtual_time(follow())


@given(st.lists(st.sampled_from(["start", "stop", "give up", "pause"]), max_size=20))
def test_the_server_does_what_was_asked_last_and_stops_are_joined_and_paced(steps: list[str]) -> None:
    """The model: commands in their order, without stops that follow a stop. An asker may have gone."""

    async def run() -> None:
        source = FakeSource()
        stops_s: list[float] = []
        loop = asyncio.get_running_loop()
        source.on_recorded = lambda start: None if start else stops_s.append(loop.time())
        asked: list[asyncio.Task[Any]] = []
        last = ""
        for step in steps:
            if step == "pause":
                await asyncio.sleep(10)
            elif step == "give up":
                if last == "stop":
                    asked[-1].cancel()
            else:
                last = step
                asked.append(asyncio.create_task(record(source, step)))
                await asyncio.sleep(0)
                await asyncio.sleep(0)
        await asyncio.sleep(100)
        await asyncio.gather(*asked, return_exceptions=True)
        commands = [step for step in steps if step in {"start", "stop"}]
        assert source.recorded.count(True) == commands.count("start")
        if commands:
            assert source.recorded[-1] is (commands[-1] == "start")
        runs = [command for command, _ in itertools.groupby(commands)]
        joined = [each for each, _ in itertools.groupby(source.recorded)]
        assert joined == [each == "start" for each in runs]
        assert source.recorded.count(False) <= commands.count("stop")
        assert all(after - before > 0.9 / STOPS_PER_S for before, after in itertools.pairwise(stops_s))

    run_in_virtual_time(run())


async def test_a_recording_whose_stop_is_refused_is_stopped_by_the_packet(source: FakeSource) -> None:
    source.server.replies = {START: OK, STOP: ServerError("err-unknown command")}
    await record(source, "start", "walk-1")
    await record(source, "stop")
    assert source.recorded == [False]


async def test_without_a_connection_nothing_is_recorded_or_followed(source: FakeSource) -> None:
    source.server.is_connected = False
    with raises(QueryError, code="no-connection"):
        await record(source, "start", "walk-1")
    assert source.followed == []


async def test_a_recording_that_cannot_start_is_followed_to_its_end(source: FakeSource) -> None:
    recording = asyncio.ensure_future(record(source, "start", "walk-1"))
    await source.server.wait_for_commands(1)
    source.server.is_connected = False
    source.server.unanswered.popleft().set_exception(ServerError("err-unknown command"))
    with raises(QueryError, code="no-connection"):
        await recording
    assert source.followed == [(True, "walk-1"), (False, "")]


async def test_a_disk_that_does_not_respond_does_not_delay_the_server(source: FakeSource) -> None:
    """The take begins before the recording, so that nothing is missing; its file may come later."""
    source.disk.clear()
    recording = asyncio.ensure_future(record(source, "start"))
    for _ in range(10):
        await asyncio.sleep(0)
    assert (source.followed, source.recorded, recording.done()) == ([(True, "")], [True], False)
    source.disk.set()
    assert (await recording)["take"] == ""


async def test_start_and_stop_are_carried_out_in_their_order(source: FakeSource) -> None:
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


async def test_an_option_is_needed() -> None:
    with raises(QueryError, "set=start;name=NAME", "set=stop", code="bad-request"):
        await FakeSource().answer("recording")
