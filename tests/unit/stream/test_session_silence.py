"""One session with a scripted server that is silent, and stops of this process, which are no silence."""

import asyncio
import logging

import pytest

from gateway.errors import DefectError, SilenceError
from gateway.rtc3d.commands import StopStreaming, Version
from gateway.stream.state import StreamState
from tests.servers import ok, packet
from tests.unit.stream.scripted_server import BROKEN_FRAME, obliging, silent_to
from tests.unit.stream.session_lab import NO_DATA, Lab, lab, now_s
from tests.virtual_time import stop_process

__all__ = ["lab"]


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
