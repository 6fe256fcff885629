"""One session with a scripted server: how it ends, and what waiting calls get."""

import asyncio

import pytest

from gateway.errors import ClosedError, LinkError
from gateway.rtc3d.commands import Version
from gateway.stream.state import StreamState
from tests.unit.stream.scripted_server import silent_to
from tests.unit.stream.session_lab import Lab, lab, now_s
from tests.virtual_time import settle

__all__ = ["lab"]


async def test_the_end_is_raised_by_every_waiting_call(lab: Lab) -> None:
    lab.server.answer = silent_to("Version")
    await lab.session.connect()
    asking = asyncio.create_task(lab.session.ask(Version()))
    monitoring = asyncio.create_task(lab.session.monitor(lab.check_silence))
    await settle()
    lab.connection.end()
    errors = await asyncio.gather(asking, monitoring, return_exceptions=True)
    assert [str(error) for error in errors] == [
        "the connection to 192.0.2.20:3020 was closed by the server"
    ] * 2
    assert not lab.session.is_open


async def test_the_first_error_wins(lab: Lab) -> None:
    await lab.streaming()
    lab.connection.send(b"HTTP/1.1 400 Bad Request\r\n\r\n")
    await settle()  # the session has aborted the connection, which ended after that
    lab.session.connection_lost(OSError("Connection reset by peer"))
    for late_call in (lab.session.monitor(lab.check_silence), lab.session.ask(Version())):
        with pytest.raises(ClosedError, match="this is not an RTC3D server"):
            await late_call
    with pytest.raises(ClosedError, match="this is not an RTC3D server"):
        lab.session.control_recording(start=True)
    assert not lab.connection.is_open


async def test_a_broken_connection_names_its_reason(lab: Lab) -> None:
    await lab.session.connect()
    lab.connection.end(OSError("Connection reset by peer"))
    with pytest.raises(ClosedError, match=r"192\.0\.2\.20:3020 broke: Connection reset by peer"):
        await lab.session.monitor(lab.check_silence)


async def test_closing_sends_bye_and_waits_for_the_server_to_close(lab: Lab) -> None:
    await lab.streaming()
    began_s = now_s()
    await lab.session.close()
    assert lab.connection.commands[-1] == "Bye"
    assert lab.connection.got_eof
    assert now_s() == began_s


async def test_closing_waits_half_a_second_for_a_server_that_does_not_close(lab: Lab) -> None:
    lab.server.closes_at_bye = False
    await lab.streaming()
    lab.connection.send_frames(1)
    began_s = now_s()
    closing = asyncio.create_task(lab.session.close())
    await settle()
    lab.connection.send_frames(2)  # was under way
    await closing
    assert now_s() - began_s == pytest.approx(0.5)
    assert not lab.connection.is_open
    assert [number for number, _ in lab.frames] == [1, 2]
    assert lab.status.state is StreamState.STREAMING  # only the supervisor reports the end


async def test_closing_ends_every_waiting_call_at_once(lab: Lab) -> None:
    lab.server.closes_at_bye = False
    lab.server.answer = silent_to("Version")
    await lab.session.connect()
    asking = asyncio.create_task(lab.session.ask(Version()))
    monitoring = asyncio.create_task(lab.session.monitor(lab.check_silence))
    await settle()
    closing = asyncio.create_task(lab.session.close())
    await settle()
    for waiting in (asking, monitoring):
        assert waiting.done()
        assert "closed by the gateway" in str(waiting.exception())
    await closing


async def test_a_connection_that_is_lost_while_closing_does_not_change_the_reason(lab: Lab) -> None:
    lab.server.closes_at_bye = False
    await lab.streaming()
    closing = asyncio.create_task(lab.session.close())
    await settle()
    began_s = now_s()
    lab.connection.end(OSError("Connection reset by peer"))
    await closing
    assert now_s() == began_s  # it does not wait for the rest of the half second
    with pytest.raises(ClosedError, match="closed by the gateway"):
        await lab.session.ask(Version())


async def test_closing_after_the_end_sends_no_bye(lab: Lab) -> None:
    await lab.streaming()
    lab.connection.end()
    await settle()
    await lab.session.close()
    assert "Bye" not in lab.connection.commands


async def test_closing_twice_and_before_connecting_does_nothing(lab: Lab) -> None:
    await lab.session.close()
    await lab.session.connect()
    await lab.session.close()
    await lab.session.close()
    assert lab.connection.commands == ["Bye"]


async def test_a_connection_lost_before_connect_returns_ends_the_session(lab: Lab) -> None:
    connecting = asyncio.create_task(lab.session.connect())
    await asyncio.sleep(0)
    lab.connection.end()
    await connecting
    await settle()
    with pytest.raises(LinkError, match="was closed by the server"):
        await lab.session.ask(Version())
