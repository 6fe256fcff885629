"""One session with a scripted server: commands and their replies, frames, files, and how it ends."""

import asyncio
import logging
import socket
import struct
from collections.abc import Callable
from typing import Any
from unittest.mock import Mock

import pytest

from gateway.errors import ClosedError, LinkError, PacketError, ReplyTimeoutError, ServerError, SilenceError
from gateway.rtc3d.commands import SendParameters, StopStreaming, StreamFrames, Version
from gateway.session.state import StreamState
from tests.support.clocks import settle
from tests.support.errors import names, raises
from tests.support.records import levels
from tests.support.servers import error, markers_frame, ok, packet
from tests.support.statuses import amounts
from tests.support.vectors import STOP_RECORDING
from tests.unit.session.scripted_server import obliging, refusing, refusing_without_name, silent_to
from tests.unit.session.session_lab import NO_DATA, Lab, now_s


@pytest.fixture
async def lab() -> Lab:
    return Lab()


@pytest.fixture
async def silent() -> Lab:
    """Return a connected lab whose server answers nothing."""
    lab = Lab(silent_to(""))
    await lab.session.connect()
    return lab


# --- commands and replies


async def test_an_answer_goes_to_the_command_that_asked_and_a_refusal_raises_the_servers_text(
    lab: Lab,
) -> None:
    await lab.session.connect()
    assert (await lab.session.ask(Version())).body == b"OK-Version 1.0"
    assert (await lab.session.ask(SendParameters())).body.startswith(b"<RT_Parameters")
    lab.server.answer = refusing("Version")
    with pytest.raises(ServerError, match=r"Error-Version 1\.0"):
        await lab.session.ask(Version())
    assert lab.session.is_open


async def test_commands_are_sent_one_at_a_time(silent: Lab) -> None:
    first = asyncio.create_task(silent.session.ask(Version()))
    second = asyncio.create_task(silent.session.ask(SendParameters()))
    await settle()
    assert silent.commands == ["Version 1.0"]
    silent.connection.send(obliging("Version 1.0"))
    await first
    await settle()
    assert silent.commands == ["Version 1.0", "SendParameters"]
    silent.connection.send(obliging("SendParameters"))
    await second


async def test_an_unanswered_command_times_out_and_its_late_reply_answers_no_other(silent: Lab) -> None:
    asked_s = now_s()
    with raises(ReplyTimeoutError, "Version 1.0", "2 s"):
        await silent.session.ask(Version())
    assert now_s() - asked_s == pytest.approx(2)
    assert silent.session.is_open
    second = asyncio.create_task(silent.session.ask(SendParameters()))
    await settle()
    silent.connection.send(obliging("Version 1.0"))
    await settle()
    assert not second.done()
    silent.connection.send(obliging("SendParameters"))
    assert (await second).body.startswith(b"<RT_Parameters")


async def test_asking_before_connecting_raises(lab: Lab) -> None:
    with pytest.raises(ClosedError, match="not connected"):
        await lab.session.ask(Version())
    with pytest.raises(ClosedError, match="not connected"):
        lab.session.control_recording(start=True)


async def test_a_packet_that_answers_nothing_is_shown_with_at_most_200_characters(
    lab: Lab, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "gateway.session.session")
    await lab.streaming(1)
    lab.connection.send(error("x" * 201))
    lab.connection.send(packet(77, b"new"))
    assert levels(caplog, logging.DEBUG) == ["DEBUG", "DEBUG"]
    refused, unknown = caplog.messages
    assert names(refused, "lab", "type 0", "x" * 200)
    assert names(unknown, "lab", "type 77", "new")


# --- replies that name no command


async def test_a_refusal_without_a_name_refuses_the_command_under_way_if_no_other_follows() -> None:
    lab = Lab(silent_to("Version", by=refusing_without_name("SendParameters")))
    await lab.session.connect()
    with pytest.raises(ReplyTimeoutError):
        await lab.session.ask(Version())
    asked_s = now_s()
    with pytest.raises(ServerError, match="what"):
        await lab.session.ask(SendParameters())
    assert now_s() - asked_s < 0.5


async def test_late_refusals_that_come_together_refuse_each_its_own_command(silent: Lab) -> None:
    with pytest.raises(ReplyTimeoutError):
        await silent.session.ask(Version())
    asking = asyncio.create_task(silent.session.ask(StreamFrames()))
    await settle()
    silent.connection.send(packet(0, "what?"))  # the late refusal of Version
    await asyncio.sleep(0.1)
    silent.connection.send(packet(1, "fine"))
    assert (await asking).body == b"fine"


async def test_a_refusal_without_a_name_after_the_command_timed_out_changes_nothing() -> None:
    lab = Lab(silent_to(""), reply_timeout_s=0.1)
    await lab.session.connect()
    for _ in range(2):
        with pytest.raises(ReplyTimeoutError):
            await lab.session.ask(Version())
    asking = asyncio.create_task(lab.session.ask(StreamFrames()))
    await asyncio.sleep(0.09)
    lab.connection.send(packet(0, "what?"))
    with pytest.raises(ReplyTimeoutError):
        await asking
    await asyncio.sleep(1)
    assert lab.session.is_open


# --- frames and states


async def test_frames_of_one_read_are_passed_on_together_with_the_time(lab: Lab) -> None:
    await lab.streaming()
    assert lab.status.byte_order == ""
    lab.connection.send_frames(1, 2, 3)
    assert lab.frames == [(1, now_s()), (2, now_s()), (3, now_s())]
    assert (lab.status.state, lab.status.byte_order) == (StreamState.STREAMING, "big")


async def test_frames_in_another_byte_order_are_a_limitation(lab: Lab) -> None:
    await lab.streaming()
    lab.connection.send(markers_frame(1, (0.0, 0.0, 0.0), order="<"))
    assert lab.status.byte_order == "little"
    [limitation] = lab.status.limitations
    assert names(limitation, "little-endian")


async def test_the_control_of_a_recording_goes_out_at_once(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    await lab.session.connect()
    written: list[bytes] = []
    monkeypatch.setattr(lab.connection, "write", written.append)
    lab.session.control_recording(start=True)
    lab.session.control_recording(start=False)
    event_id = b"\0\0\0\1"
    assert written == [STOP_RECORDING[:-24] + event_id + STOP_RECORDING[-20:], STOP_RECORDING]


async def test_a_stopped_stream_is_idle_once_the_server_has_answered(lab: Lab) -> None:
    await lab.streaming(1)
    lab.status.handshake_done(lab.session.protocol_state, lab.session.server, "StreamFrames")
    lab.server.answer = silent_to("StreamFrames Stop")
    stopping = asyncio.create_task(lab.session.ask(StopStreaming()))
    await settle()
    assert lab.status.state.value == "streaming"
    lab.connection.send(obliging("StreamFrames Stop"))
    await stopping
    assert lab.status.state is StreamState.IDLE
    lab.connection.send_frames(2)  # was under way
    assert lab.status.state is StreamState.IDLE


async def test_a_stop_without_an_answer_is_believed_until_the_next_frame(lab: Lab) -> None:
    await lab.streaming(1)
    lab.status.handshake_done(lab.session.protocol_state, lab.session.server, "StreamFrames")
    lab.server.answer = silent_to("StreamFrames Stop")
    with pytest.raises(ReplyTimeoutError):
        await lab.session.ask(StopStreaming())
    assert lab.status.state.value == "idle"
    lab.connection.send_frames(2)
    assert lab.status.state is StreamState.STREAMING


async def test_a_rejected_frame_is_counted_and_the_next_is_passed_on(
    lab: Lab, caplog: pytest.LogCaptureFixture
) -> None:
    await lab.streaming()
    contradictory = bytearray(markers_frame(1, (0.0, 0.0, 0.0)))
    contradictory[8:12] = (2).to_bytes(4, "big")  # announces 2 components, of which the stream has 1
    contradictory[32:36] = (9).to_bytes(4, "big")  # announces 9 markers
    lab.connection.send(bytes(contradictory) + markers_frame(2, (0.0, 0.0, 0.0)))
    assert lab.numbers == [2]
    assert amounts(lab.status.losses.report()) == {"frame rejected": (1, 1)}
    assert lab.status.last_error.startswith("frame rejected: ")
    assert any(record.levelname == "WARNING" for record in caplog.records)


# --- C3D files


async def send_slowly(lab: Lab, pause_s: float) -> None:
    file = packet(5, bytes(20))
    lab.connection.send(file[:9])
    for byte in file[9:]:
        await asyncio.sleep(pause_s)
        lab.connection.send(bytes([byte]))


async def test_a_file_that_takes_long_is_no_silence(lab: Lab) -> None:
    await lab.streaming(1)
    async with lab.monitored() as monitoring:
        await send_slowly(lab, 2.9)  # the server is silent after 3 s
        assert not monitoring.done()
        with raises(SilenceError, "no frame"):
            await monitoring


async def test_the_reply_to_a_command_may_be_behind_a_file(silent: Lab) -> None:
    asking = asyncio.create_task(silent.session.ask(Version()))
    await settle()
    await send_slowly(silent, 1.9)  # the server does not answer after 2 s
    silent.connection.send(ok("OK-Version"))
    assert (await asking).body == b"OK-Version"


# --- the connection


async def test_the_kernel_is_asked_to_detect_a_server_that_has_vanished(lab: Lab) -> None:
    options: list[tuple[object, ...]] = []
    transport = Mock()
    transport.get_extra_info.return_value.setsockopt = lambda *option: options.append(option)
    lab.session.connection_made(transport)
    transport.get_extra_info.assert_called_once_with("socket")
    assert (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1) in options


@pytest.mark.parametrize(("packet_type", "limit"), [(3, 1024), (5, 4096)])
async def test_packets_above_the_configured_limits_end_the_session(packet_type: int, limit: int) -> None:
    lab = Lab(max_packet_bytes=1024, max_c3d_bytes=4096)
    await lab.streaming()
    lab.connection.send(struct.pack(">II", limit, packet_type) + (limit - 8) * b"\xff")
    assert lab.session.is_open
    lab.connection.send(struct.pack(">II", limit + 1, packet_type))
    text = rf"packet size {limit + 1} \(limit {limit}\), type {packet_type}"
    with pytest.raises(ClosedError, match=text) as caught:
        await lab.session.monitor(lab.check_silence)
    assert isinstance(caught.value.__cause__, PacketError)


# --- the end


@pytest.mark.parametrize(
    ("end", "reason"),
    [
        (lambda lab: lab.connection.end(), "by the server"),
        (lambda lab: lab.connection.end(OSError("reset by peer")), "reset by peer"),
        (lambda lab: asyncio.create_task(lab.session.close()), "by the gateway"),
    ],
    ids=["closed by the server", "broken", "closed by the gateway"],
)
async def test_the_end_is_raised_by_every_waiting_call_at_once(
    silent: Lab, end: Callable[[Lab], asyncio.Task[None] | None], reason: str
) -> None:
    silent.server.closes_at_bye = False
    tasks: list[asyncio.Task[Any]] = [
        asyncio.create_task(silent.session.ask(Version())),
        asyncio.create_task(silent.session.monitor(silent.check_silence)),
    ]
    await settle()
    began_s = now_s()
    ending = end(silent)
    await settle()
    for task in tasks:
        assert task.done()
        assert names(str(task.exception()), "192.0.2.20:3020", reason)
    assert (now_s(), silent.session.is_open) == (began_s, False)
    if ending is not None:
        await ending


async def test_the_first_error_wins(lab: Lab) -> None:
    await lab.streaming()
    lab.connection.send(b"HTTP/1.1 400 Bad Request\r\n\r\n")
    await settle()  # the session has aborted the connection, which ended after that
    lab.session.connection_lost(OSError("Connection reset by peer"))
    lab.session.data_received(NO_DATA)
    assert lab.status.state is not StreamState.NO_MEASUREMENT
    for late_call in (lab.session.monitor(lab.check_silence), lab.session.ask(Version())):
        with raises(ClosedError, "RTC3D"):
            await late_call
    with raises(ClosedError, "RTC3D"):
        lab.session.control_recording(start=True)
    assert not lab.connection.is_open


async def test_closing_sends_bye_once_and_waits_for_the_server_to_close(lab: Lab) -> None:
    await lab.session.close()  # before connecting, this does nothing
    await lab.session.connect()
    began_s = now_s()
    for _ in range(2):
        await lab.session.close()
    assert (lab.commands, lab.connection.got_eof, now_s()) == (["Bye"], True, began_s)


async def test_closing_waits_half_a_second_for_a_server_that_does_not_close(lab: Lab) -> None:
    lab.server.closes_at_bye = False
    await lab.streaming(1)
    began_s = now_s()
    closing = asyncio.create_task(lab.session.close())
    await settle()
    lab.connection.send_frames(2)  # was under way
    await closing
    assert now_s() - began_s == pytest.approx(0.5)
    assert not lab.connection.is_open
    assert lab.numbers == [1, 2]
    assert lab.status.state is StreamState.STREAMING  # only the supervisor reports the end


async def test_a_connection_that_is_lost_while_closing_does_not_change_the_reason(lab: Lab) -> None:
    lab.server.closes_at_bye = False
    await lab.streaming()
    closing = asyncio.create_task(lab.session.close())
    await settle()
    began_s = now_s()
    lab.connection.end(OSError("Connection reset by peer"))
    await closing
    assert now_s() == began_s  # it does not wait for the rest of the half second
    with raises(ClosedError, "by the gateway"):
        await lab.session.ask(Version())


async def test_closing_after_the_end_sends_no_bye(lab: Lab) -> None:
    await lab.streaming()
    lab.connection.end()
    await settle()
    await lab.session.close()
    assert "Bye" not in lab.commands


async def test_a_connection_lost_before_connect_returns_ends_the_session(lab: Lab) -> None:
    connecting = asyncio.create_task(lab.session.connect())
    await asyncio.sleep(0)
    lab.connection.end()
    await connecting
    await settle()
    with raises(LinkError, "by the server"):
        await lab.session.ask(Version())
