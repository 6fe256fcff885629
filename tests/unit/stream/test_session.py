"""One session with a scripted server: replies, silence, errors and the end."""

import asyncio
import logging
import socket
import struct
from typing import Any
from unittest.mock import Mock

import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import ClosedError, DefectError, LinkError, ReplyTimeoutError, ServerError, SilenceError
from gateway.rtc3d.commands import SendParameters, StopStreaming, StreamFrames, Version
from gateway.rtc3d.frames import Frame
from gateway.stream.session import Session
from gateway.stream.state import StreamState
from gateway.stream.status import StreamStatus
from tests.losses import amounts
from tests.servers import markers_frame, ok, packet
from tests.unit.stream.collected_files import CollectedFiles
from tests.unit.stream.scripted_server import (
    BROKEN_FRAME,
    Connection,
    ScriptedServer,
    obliging,
    refusing,
    refusing_without_name,
    silent_to,
)
from tests.unit.stream.virtual_time import EPOCH_UTIME, read_clocks, settle, stop_process
from tests.vectors import STOP_RECORDING

NO_DATA = packet(4)


class Lab:
    """A session and its server. ``frames`` and ``files`` are those that the session passed on.

    ``checks_s`` is when it asked for a check of the silence.
    """

    def __init__(self, components: tuple[str, ...] = ("3d",), **settings: Any) -> None:
        self.server = ScriptedServer()
        self.status = StreamStatus("3d", name="lab (3d)")
        self.frames: list[tuple[int, float]] = []
        self.files = CollectedFiles()
        self.checks_s: list[float] = []
        self.session = Session(
            SourceSettings(name="lab", host="192.0.2.20", **settings),
            StreamSettings.model_validate({"components": components}),
            self.status,
            self._on_frames,
            self.files,
            self.server.connect,
            read_clocks,
        )

    def _on_frames(self, frames: list[Frame], utime: int, steady_us: int) -> None:
        assert utime == EPOCH_UTIME + steady_us
        self.frames += [(frame.components[0].frame_number, steady_us / 1e6) for frame in frames]

    async def check_silence(self) -> None:
        self.checks_s.append(now_s())

    @property
    def connection(self) -> Connection:
        return self.server.connection

    async def streaming(self) -> None:
        """Connect and request frames."""
        await self.session.connect()
        await self.session.ask(StreamFrames())


@pytest.fixture
async def lab() -> Lab:
    return Lab()


def now_s() -> float:
    return asyncio.get_running_loop().time()


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


# --- silence


async def test_silence_while_a_measurement_runs_ends_the_session(
    lab: Lab, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    await lab.streaming()
    lab.connection.send_frames(1)
    since_s = now_s()
    with pytest.raises(SilenceError, match=r"no frame from 192\.0\.2\.20:3020 for 3 s although"):
        await lab.session.monitor(lab.check_silence)
    assert now_s() - since_s == pytest.approx(3)
    assert lab.status.state is StreamState.STALLED
    assert (
        caplog.messages[-1]
        == "lab (3d): streaming → stalled: silence (no frame from 192.0.2.20:3020 for 3 s)"
    )


async def test_frames_that_are_all_rejected_are_not_called_silence(lab: Lab) -> None:
    await lab.streaming()
    lab.connection.send_frames(1)
    asyncio.get_running_loop().call_later(2, lab.connection.send, BROKEN_FRAME)
    with pytest.raises(SilenceError, match=r"all frames from 192\.0\.2\.20:3020 are rejected: component"):
        await lab.session.monitor(lab.check_silence)


async def test_each_frame_restarts_the_stall_timeout(lab: Lab) -> None:
    await lab.streaming()
    lab.connection.send_frames(1)
    monitoring = asyncio.create_task(lab.session.monitor(lab.check_silence))
    for number in range(2, 8):
        await asyncio.sleep(2.5)
        lab.connection.send_frames(number)
    since_s = now_s()
    with pytest.raises(SilenceError):
        await monitoring
    assert now_s() - since_s == pytest.approx(3)


async def test_silence_is_measured_from_the_last_frame_however_soon_it_came(lab: Lab) -> None:
    await lab.streaming()
    lab.connection.send_frames(1)
    since_s = now_s()
    monitoring = asyncio.create_task(lab.session.monitor(lab.check_silence))
    await asyncio.sleep(0.4)
    lab.connection.send_frames(2)
    with pytest.raises(SilenceError):
        await monitoring
    assert now_s() - since_s == pytest.approx(3.4)


async def test_packets_that_are_no_frames_do_not_end_the_silence(lab: Lab) -> None:
    await lab.streaming()
    lab.connection.send_frames(1)
    since_s = now_s()
    monitoring = asyncio.create_task(lab.session.monitor(lab.check_silence))
    for _ in range(2):
        await asyncio.sleep(1)
        lab.connection.send(packet(77))
    with pytest.raises(SilenceError):
        await monitoring
    assert now_s() - since_s == pytest.approx(3)


async def test_silence_without_a_measurement_is_checked_every_stall_timeout(lab: Lab) -> None:
    await lab.streaming()
    lab.connection.send(NO_DATA)
    began_s = now_s()
    monitoring = asyncio.create_task(lab.session.monitor(lab.check_silence))
    await asyncio.sleep(10)
    assert lab.checks_s == pytest.approx([began_s + 3, began_s + 6, began_s + 9])
    assert not monitoring.done()
    monitoring.cancel()


async def test_a_failed_check_of_the_silence_ends_monitoring(lab: Lab) -> None:
    async def fail() -> None:
        raise SilenceError("no answer")

    await lab.streaming()
    with pytest.raises(SilenceError, match="no answer"):
        await lab.session.monitor(fail)


async def test_the_stall_timeout_begins_again_when_a_measurement_ends(lab: Lab) -> None:
    await lab.streaming()
    lab.connection.send_frames(1)
    monitoring = asyncio.create_task(lab.session.monitor(lab.check_silence))
    await asyncio.sleep(2.9)
    lab.connection.send(NO_DATA)
    await asyncio.sleep(2.9)
    assert lab.checks_s == []
    await asyncio.sleep(0.2)
    assert len(lab.checks_s) == 1
    monitoring.cancel()


async def test_a_stream_of_events_alone_may_be_silent_during_a_measurement() -> None:
    lab = Lab(components=("event",))
    await lab.streaming()
    lab.connection.send_frames(1)
    assert lab.status.state is StreamState.STREAMING
    monitoring = asyncio.create_task(lab.session.monitor(lab.check_silence))
    await asyncio.sleep(61)
    assert not monitoring.done()
    assert len(lab.checks_s) == 20
    monitoring.cancel()


async def test_frames_may_stop_before_a_slow_server_answers_the_stop() -> None:
    lab = Lab(reply_timeout_s=10)
    await lab.streaming()
    lab.connection.send_frames(1)
    lab.server.answer = silent_to("StreamFrames Stop")
    stopping = asyncio.create_task(lab.session.ask(StopStreaming()))
    monitoring = asyncio.create_task(lab.session.monitor(lab.check_silence))
    await asyncio.sleep(5)
    assert not monitoring.done()
    lab.connection.send(obliging("StreamFrames Stop"))
    await stopping
    monitoring.cancel()


async def test_a_defect_in_what_takes_frames_ends_the_session(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    await lab.streaming()
    monkeypatch.setattr(lab, "frames", None)
    lab.connection.send_frames(1)
    with pytest.raises(DefectError, match="defect in the gateway: TypeError: ") as caught:
        await lab.session.monitor(lab.check_silence)
    assert isinstance(caught.value.__cause__, TypeError)
    assert not lab.connection.is_open


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


# --- a stop of this process


@pytest.mark.parametrize("stop_s", [3.1, 30.0])
async def test_a_stop_of_this_process_is_not_the_servers_silence(lab: Lab, stop_s: float) -> None:
    await lab.streaming()
    lab.connection.send_frames(1)
    monitoring = asyncio.create_task(lab.session.monitor(lab.check_silence))
    await asyncio.sleep(2.7)
    stop_process(stop_s)
    asyncio.get_running_loop().call_later(0.05, lab.connection.send_frames, 2, 3)
    await asyncio.sleep(2.9)
    assert not monitoring.done()
    assert [number for number, _ in lab.frames] == [1, 2, 3]
    with pytest.raises(SilenceError, match="no frame from"):  # what is silent then is the server
        await monitoring


async def test_a_stop_of_this_process_is_not_a_server_that_does_not_answer(lab: Lab) -> None:
    lab.server.answer = silent_to("Version")
    await lab.session.connect()
    asking = asyncio.create_task(lab.session.ask(Version()))
    await asyncio.sleep(1)
    stop_process(10)
    asyncio.get_running_loop().call_later(0.7, lab.connection.send, ok("OK-Version"))
    assert (await asking).body == b"OK-Version"


# --- the end


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
