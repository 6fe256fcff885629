"""One session with a scripted server that is silent, and stops of this process, which are no silence."""

import asyncio
import logging

import pytest

from gateway.errors import SilenceError
from gateway.rtc3d.commands import StopStreaming, Version
from gateway.session.state import StreamState
from tests.support.clocks import stop_process
from tests.support.errors import raises
from tests.support.servers import ok, packet
from tests.unit.session.scripted_server import BROKEN_FRAME, obliging, silent_to
from tests.unit.session.session_lab import NO_DATA, Lab, now_s


@pytest.fixture
async def lab() -> Lab:
    """Return a lab that has received a frame of a measurement."""
    lab = Lab()
    await lab.streaming(1)
    return lab


async def test_silence_while_a_measurement_runs_ends_the_session(
    lab: Lab, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    since_s = now_s()
    with raises(SilenceError, "no frame", "192.0.2.20:3020", "3 s"):
        await lab.session.monitor(lab.check_silence)
    assert now_s() - since_s == pytest.approx(3)
    assert lab.status.state is StreamState.STALLED
    text = "streaming → stalled: silence (no frame from 192.0.2.20:3020 for 3 s)"
    assert caplog.messages[-1] == f"lab (3d): {text}"


@pytest.mark.parametrize("before", [b"", NO_DATA], ids=["during a measurement", "of the next one"])
async def test_frames_that_are_all_rejected_are_not_called_silence(lab: Lab, before: bytes) -> None:
    """A new connection detects the byte order again; waiting for a measurement would never end."""
    asyncio.get_running_loop().call_later(2, lab.connection.send, before + BROKEN_FRAME)
    if before:
        asyncio.get_running_loop().call_later(4, lab.connection.send, BROKEN_FRAME)
    with raises(SilenceError, "rejected", "192.0.2.20:3020", "component"):
        await lab.session.monitor(lab.check_silence)


@pytest.mark.parametrize("pauses_s", [[2.5] * 6, [0.4]], ids=["each frame", "a frame that comes soon"])
async def test_silence_is_measured_from_the_last_frame(lab: Lab, pauses_s: list[float]) -> None:
    async with lab.monitored() as monitoring:
        for pause_s in pauses_s:
            await asyncio.sleep(pause_s)
            lab.connection.send_frames(2)
        since_s = now_s()
        for _ in range(2):
            await asyncio.sleep(1)
            lab.connection.send(packet(77))  # no frame
        with pytest.raises(SilenceError):
            await monitoring
    assert now_s() - since_s == pytest.approx(3)


async def test_silence_without_a_measurement_is_checked_every_stall_timeout_from_its_end(lab: Lab) -> None:
    async with lab.monitored() as monitoring:
        await asyncio.sleep(2.9)
        lab.connection.send(NO_DATA)
        began_s = now_s()
        await asyncio.sleep(10)
        assert lab.checks_s == pytest.approx([began_s + 3, began_s + 6, began_s + 9])
        assert not monitoring.done()


async def test_a_stream_of_events_alone_may_be_silent_during_a_measurement() -> None:
    lab = Lab(components=("event",))
    await lab.streaming(1)
    assert lab.status.state is StreamState.STREAMING
    async with lab.monitored() as monitoring:
        await asyncio.sleep(61)
        assert (monitoring.done(), len(lab.checks_s)) == (False, 20)


async def test_frames_may_stop_before_a_slow_server_answers_the_stop() -> None:
    lab = Lab(silent_to("StreamFrames Stop"), reply_timeout_s=10)
    await lab.streaming(1)
    stopping = asyncio.create_task(lab.session.ask(StopStreaming()))
    async with lab.monitored() as monitoring:
        await asyncio.sleep(5)
        assert not monitoring.done()
        lab.connection.send(obliging("StreamFrames Stop"))
        await stopping


# --- a stop of this process


@pytest.mark.parametrize("stop_s", [3.1, 30.0])
async def test_a_stop_of_this_process_is_not_the_servers_silence(lab: Lab, stop_s: float) -> None:
    async with lab.monitored() as monitoring:
        await asyncio.sleep(2.7)
        stop_process(stop_s)
        asyncio.get_running_loop().call_later(0.05, lab.connection.send_frames, 2, 3)
        await asyncio.sleep(2.9)
        assert (monitoring.done(), lab.numbers) == (False, [1, 2, 3])
        with raises(SilenceError, "no frame"):  # what is silent then is the server
            await monitoring


async def test_a_stop_of_this_process_is_not_a_server_that_does_not_answer() -> None:
    lab = Lab(silent_to("Version"))
    await lab.session.connect()
    asking = asyncio.create_task(lab.session.ask(Version()))
    await asyncio.sleep(1)
    stop_process(10)
    asyncio.get_running_loop().call_later(0.7, lab.connection.send, ok("OK-Version"))
    assert (await asking).body == b"OK-Version"
