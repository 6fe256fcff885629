"""One session with a scripted server: commands and their replies, frames and the connection."""

import asyncio
import socket
import struct
from unittest.mock import Mock

import pytest

from gateway.errors import ClosedError, ReplyTimeoutError, ServerError, SilenceError
from gateway.rtc3d.commands import SendParameters, StopStreaming, StreamFrames, Version
from gateway.stream.state import StreamState
from tests.losses import amounts
from tests.servers import markers_frame, ok, packet
from tests.unit.stream.scripted_server import obliging, refusing, refusing_without_name, silent_to
from tests.unit.stream.session_lab import Lab, lab, now_s
from tests.vectors import STOP_RECORDING
from tests.virtual_time import settle

__all__ = ["lab"]


# --- commands and replies


async def test_an_answer_goes_to_the_command_that_asked(lab: Lab) -> None:
    await lab.session.connect()
    assert (await lab.session.ask(Version())).body == b"OK-Version 1.0"
    assert (await lab.session.ask(SendParameters())).body.startswith(b"<RT_Parameters")


async def test_a_refusal_raises_the_servers_text(lab: Lab) -> None:
    lab.server.answer = refusing("Version")
    await lab.session.connect()
    with pytest.raises(ServerError, match=r"Error-Version 1\.0"):
        await lab.session.ask(Version())
    assert lab.session.is_open


async def test_commands_are_sent_one_at_a_time(lab: Lab) -> None:
    lab.server.answer = silent_to("")
    await lab.session.connect()
    first = asyncio.create_task(lab.session.ask(Version()))
    second = asyncio.create_task(lab.session.ask(SendParameters()))
    await settle()
    assert lab.connection.commands == ["Version 1.0"]
    lab.connection.send(obliging("Version 1.0"))
    await first
    await settle()
    assert lab.connection.commands == ["Version 1.0", "SendParameters"]
    lab.connection.send(obliging("SendParameters"))
    await second


async def test_an_unanswered_command_times_out_and_its_late_reply_answers_no_other(lab: Lab) -> None:
    lab.server.answer = silent_to("Version")
    await lab.session.connect()
    asked_s = now_s()
    with pytest.raises(ReplyTimeoutError, match=r"did not answer Version 1\.0 within 2 s"):
        await lab.session.ask(Version())
    assert now_s() - asked_s == pytest.approx(2)
    assert lab.session.is_open
    lab.server.answer = silent_to("")
    second = asyncio.create_task(lab.session.ask(SendParameters()))
    await settle()
    lab.connection.send(obliging("Version 1.0"))
    await settle()
    assert not second.done()
    lab.connection.send(obliging("SendParameters"))
    assert (await second).body.startswith(b"<RT_Parameters")


async def test_asking_before_connecting_raises(lab: Lab) -> None:
    with pytest.raises(ClosedError, match="not connected"):
        await lab.session.ask(Version())
    with pytest.raises(ClosedError, match="not connected"):
        lab.session.control_recording(start=True)


# --- replies that name no command


async def test_a_refusal_without_a_name_refuses_the_command_under_way_if_no_other_follows(lab: Lab) -> None:
    lab.server.answer = silent_to("Version", by=refusing_without_name("SendParameters"))
    await lab.session.connect()
    with pytest.raises(ReplyTimeoutError):
        await lab.session.ask(Version())
    asked_s = now_s()
    with pytest.raises(ServerError, match="what"):
        await lab.session.ask(SendParameters())
    assert now_s() - asked_s < 0.5


async def test_late_refusals_that_come_together_refuse_each_its_own_command(lab: Lab) -> None:
    lab.server.answer = silent_to("")
    await lab.session.connect()
    with pytest.raises(ReplyTimeoutError):
        await lab.session.ask(Version())
    asking = asyncio.create_task(lab.session.ask(StreamFrames()))
    await settle()
    lab.connection.send(packet(0, "what?"))  # the late refusal of Version
    await asyncio.sleep(0.1)
    lab.connection.send(packet(1, "fine"))
    assert (await asking).body == b"fine"


async def test_a_refusal_without_a_name_after_the_command_timed_out_changes_nothing() -> None:
    lab = Lab(reply_timeout_s=0.1)
    lab.server.answer = silent_to("")
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
    lab.connection.send_frames(1, 2, 3)
    assert lab.frames == [(1, now_s()), (2, now_s()), (3, now_s())]
    assert lab.status.state is StreamState.STREAMING
    assert lab.status.byte_order == "big"


async def test_the_control_of_a_recording_goes_out_at_once(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    await lab.session.connect()
    written: list[bytes] = []
    monkeypatch.setattr(lab.connection, "write", written.append)
    lab.session.control_recording(start=True)
    lab.session.control_recording(start=False)
    start, stop = written
    assert stop == STOP_RECORDING
    assert start == STOP_RECORDING[:-24] + b"\0\0\0\1" + STOP_RECORDING[-20:]  # the event's id


async def test_a_stopped_stream_is_idle_once_the_server_has_answered(lab: Lab) -> None:
    await lab.streaming()
    lab.connection.send_frames(1)
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


async def test_a_refused_stop_leaves_the_stream_streaming(lab: Lab) -> None:
    await lab.streaming()
    lab.connection.send_frames(1)
    lab.server.answer = refusing("StreamFrames Stop")
    with pytest.raises(ServerError):
        await lab.session.ask(StopStreaming())
    assert lab.status.state is StreamState.STREAMING


async def test_a_stop_without_an_answer_is_believed_until_the_next_frame(lab: Lab) -> None:
    await lab.streaming()
    lab.connection.send_frames(1)
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
    good = markers_frame(2, (0.0, 0.0, 0.0))
    contradictory = bytearray(markers_frame(1, (0.0, 0.0, 0.0)))
    contradictory[32:36] = (9).to_bytes(4, "big")  # announces 9 markers
    lab.connection.send(bytes(contradictory) + good)
    assert [number for number, _ in lab.frames] == [2]
    assert amounts(lab.status.losses.report()) == {"frame rejected": (1, 1)}
    assert lab.status.last_error.startswith("frame rejected: ")
    assert any(record.levelname == "WARNING" for record in caplog.records)


async def test_a_c3d_file_is_passed_on_in_pieces(lab: Lab) -> None:
    await lab.streaming()
    file = packet(5, b"content")
    lab.connection.send(file[:11])
    lab.connection.send(file[11:])
    assert lab.files.pieces == [b"con", b"tent"]
    assert lab.files.interruptions == []


async def test_the_end_of_the_session_interrupts_a_file_and_later_pieces_are_ignored(lab: Lab) -> None:
    await lab.streaming()
    lab.connection.send(packet(5, b"content")[:-1])
    closing = asyncio.create_task(lab.session.close())
    await settle()
    assert lab.files.interruptions == ["the connection to 192.0.2.20:3020 was closed by the gateway"]
    lab.connection.send(b"t" + packet(5, b"another"))
    assert lab.files.pieces == [b"conten"]
    await closing


async def test_a_file_that_takes_long_is_no_silence(lab: Lab) -> None:
    await lab.streaming()
    lab.connection.send_frames(1)
    file = packet(5, bytes(20))
    monitoring = asyncio.create_task(lab.session.monitor(lab.check_silence))
    lab.connection.send(file[:9])
    for byte in file[9:]:
        await asyncio.sleep(2.9)  # the server is silent after 3 s
        lab.connection.send(bytes([byte]))
    assert not monitoring.done()
    with pytest.raises(SilenceError, match="no frame from"):
        await monitoring


async def test_the_reply_to_a_command_may_be_behind_a_file(lab: Lab) -> None:
    lab.server.answer = silent_to("Version")
    await lab.session.connect()
    asking = asyncio.create_task(lab.session.ask(Version()))
    await settle()
    file = packet(5, bytes(20))
    lab.connection.send(file[:9])
    for byte in file[9:]:
        await asyncio.sleep(1.9)  # the server does not answer after 2 s
        lab.connection.send(bytes([byte]))
    lab.connection.send(ok("OK-Version"))
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
    with pytest.raises(ClosedError, match=rf"packet size {limit + 1} \(limit {limit}\), type {packet_type}"):
        await lab.session.monitor(lab.check_silence)


async def test_the_byte_order_is_unknown_before_the_first_frame(lab: Lab) -> None:
    await lab.streaming()
    assert lab.status.byte_order == ""
    lab.connection.send_frames(1)
    assert lab.status.byte_order == "big"
