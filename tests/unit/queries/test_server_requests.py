import asyncio
import contextlib
import re

import pytest

from gateway.errors import ClosedError, QueryError, ReplyTimeoutError, ServerError
from gateway.queries.server_requests import ServerRequests
from gateway.rtc3d.commands import SendCurrentFrame, SendParameters
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
    command, packet = await requests.send(SendParameters(("3d",)), fallback=SendParameters())
    assert (command, packet.body) == (SendParameters(), b"<a/>")
    source.server.replies = {"SendCurrentFrame 3D": ServerError("a"), "SendCurrentFrame": ServerError("b")}
    [component, _] = source.streams[0].components
    with pytest.raises(QueryError, match="the server does not know SendCurrentFrame, or refuses it: b"):
        await requests.send(SendCurrentFrame((component,)), fallback=SendCurrentFrame())


@pytest.mark.parametrize(
    ("reply", "code", "text"),
    [
        (
            ReplyTimeoutError("192.0.2.1:3020 did not answer"),
            "timeout",
            "source 'lab': 192.0.2.1:3020 did not answer",
        ),
        (None, "timeout", "source 'lab': no answer within 0.05 s; queries waiting for the server: 1"),
        (ClosedError("closed"), "no-connection", "source 'lab' has just lost its connection: closed"),
    ],
    ids=["the server is silent", "the query may wait no longer", "the connection is lost"],
)
async def test_a_command_without_a_reply_is_an_error_and_the_next_one_is_sent(
    reply: Exception | None, code: str, text: str
) -> None:
    source = FakeSource(query_timeout_s=0.05)
    if reply is not None:
        source.server.replies["SendParameters"] = reply
    error = await source.parameters_error()
    assert (error.code, str(error)) == (code, text)
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
    assert str(error) == "source 'lab' has no connection yet: connecting to 192.0.2.1:3020"
    source.status.record_error("connection refused by 192.0.2.1:3020; is the RT server running?")
    source.status.last_error_s -= 300
    source.second_status.record_error("an older error")
    source.second_status.last_error_s -= 400
    problem, _, remedy = str(await source.parameters_error(stale_ok=True)).partition("; ")
    assert re.fullmatch(
        r"source 'lab' has no connection: refused by 192.0.2.1:3020, tried 3..\.. s ago", problem
    )
    assert remedy == "is the RT server running?"
