"""A session whose frames arrive faster than they were measured: pace, time-outs and the end."""

import asyncio
from typing import Any

import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import DefectError, ReplyTimeoutError, SilenceError
from gateway.rtc3d.commands import StreamFrames, Version
from gateway.rtc3d.frames import Frame
from gateway.stream.files import IgnoredFiles
from gateway.stream.session import Session
from gateway.stream.status import StreamStatus
from tests.servers import packet
from tests.unit.stream.scripted_server import Connection, ScriptedServer, silent_to
from tests.virtual_time import read_clocks, settle, until


class Lab:
    """A session and its server. ``frames`` are the number and the time of arrival of those published."""

    def __init__(self, **stream: Any) -> None:
        self.server = ScriptedServer()
        self.status = StreamStatus("3d", name="lab (3d)")
        self.frames: list[tuple[int, float]] = []
        self.session = Session(
            SourceSettings(name="lab", host="192.0.2.20"),
            StreamSettings.model_validate({"components": ["3d"], **stream}),
            self.status,
            self._on_frames,
            IgnoredFiles(),
            self.server.connect,
            read_clocks,
        )

    def _on_frames(self, frames: list[Frame], _utime: int, steady_us: int) -> None:
        self.frames += [(frame.components[0].frame_number, steady_us / 1e6) for frame in frames]

    @property
    def connection(self) -> Connection:
        return self.server.connection


@pytest.fixture
async def lab() -> Lab:
    return Lab()


async def no_check() -> None:
    raise AssertionError("silence is a fault while a measurement runs")


def now_s() -> float:
    return asyncio.get_running_loop().time()


async def backlog(lab: Lab, count: int = 2000) -> None:
    """Stream with a clock, and let ``count`` frames, 1 ms apart, arrive together."""
    lab.status.clock.has_clock = True
    await lab.session.connect()
    await lab.session.ask(StreamFrames())
    lab.connection.send_frames(*range(count))


def numbers(lab: Lab) -> list[int]:
    return [number for number, _ in lab.frames]


async def test_a_few_frames_are_published_at_once(lab: Lab) -> None:
    await backlog(lab, 4)
    assert numbers(lab) == list(range(4))
    assert lab.connection.is_read


async def test_a_backlog_is_published_at_twice_its_rate_while_nothing_is_read(lab: Lab) -> None:
    began_s = now_s()
    await backlog(lab)
    assert len(lab.frames) < 10
    assert not lab.connection.is_read
    await until(lambda: lab.connection.is_read)
    assert numbers(lab) == list(range(2000))
    assert now_s() - began_s == pytest.approx(1.0, abs=0.05)
    assert {arrived_s for _, arrived_s in lab.frames} == {began_s}, "the time of arrival is that of the read"


async def test_latest_takes_a_batch_whole() -> None:
    lab = Lab(backlog="latest")
    await backlog(lab)
    assert numbers(lab) == list(range(2000))


async def test_the_speed_is_adjustable() -> None:
    lab = Lab(backlog_speed=10.0)
    began_s = now_s()
    await backlog(lab)
    await until(lambda: lab.connection.is_read)
    assert now_s() - began_s == pytest.approx(0.2, abs=0.05)


async def test_a_reply_behind_a_backlog_is_waited_for(lab: Lab) -> None:
    lab.server.answer = silent_to("Version")
    await backlog(lab, 6000)
    asked_s = now_s()
    asking = asyncio.create_task(lab.session.ask(Version()))
    await until(lambda: lab.connection.is_read)
    assert now_s() - asked_s > 2.5, "longer than reply_timeout_s"
    await asyncio.sleep(1.5)
    lab.connection.send(packet(1, "OK-Version"))
    assert (await asking).body == b"OK-Version"


async def test_a_command_without_an_answer_times_out_after_the_backlog(lab: Lab) -> None:
    lab.server.answer = silent_to("Version")
    await backlog(lab, 6000)
    asked_s = now_s()
    with pytest.raises(ReplyTimeoutError):
        await lab.session.ask(Version())
    assert now_s() - asked_s == pytest.approx(3 + 2, abs=0.2)


async def test_a_backlog_is_not_silence(lab: Lab) -> None:
    await backlog(lab, 10_000)
    began_s = now_s()
    with pytest.raises(SilenceError):
        await lab.session.monitor(no_check)
    assert now_s() - began_s == pytest.approx(5 + 3, abs=0.2)
    assert len(lab.frames) == 10_000


async def test_the_end_of_the_session_publishes_what_waits(lab: Lab) -> None:
    await backlog(lab)
    await lab.session.close()
    assert numbers(lab) == list(range(2000))
    assert not lab.connection.is_open


async def test_after_bye_frames_are_published_as_they_arrive(lab: Lab) -> None:
    lab.server.closes_at_bye = False
    await backlog(lab, 1)
    closing = asyncio.create_task(lab.session.close())
    await settle()
    lab.connection.send_frames(*range(1, 100))
    assert len(lab.frames) == 100
    assert lab.connection.is_read
    await closing


async def test_a_connection_that_breaks_publishes_what_waits(lab: Lab) -> None:
    await backlog(lab)
    lab.connection.end(OSError("broken"))
    await settle()
    assert numbers(lab) == list(range(2000))


async def test_a_defect_in_publishing_ends_the_session(lab: Lab) -> None:
    await backlog(lab)
    del lab.frames
    await until(lambda: not lab.connection.is_open)
    with pytest.raises(DefectError, match="AttributeError"):
        await lab.session.ask(Version())
