"""Takes that follow measurements, recordings and events of the server, in virtual time."""

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import rtc3d

from gateway.outputs.takes.follow import END_S, LOST_S, event_ids
from gateway.takes.files.reader import TakeReader
from tests.support.clocks import Clock
from tests.support.errors import names
from tests.support.recording_output import RecordingLab, still_lab
from tests.support.vectors import LONG_EVENTS
from tests.support.waiting import wait_until_async
from tests.unit.messages.samples import component_message


class Followed:
    """A source whose takes follow its server; its clock is the test's."""

    def __init__(self, lab: RecordingLab, clock: Clock) -> None:
        self.lab = lab
        self.clock = clock
        self.follower = lab.output._follower("lab")

    def show(self, is_running: bool | None, then_s: float = 0.0) -> None:
        """Show whether a measurement runs; wait so long."""
        self.lab.output.show_measurement("lab", is_running)
        if then_s:
            self.wait(then_s)

    def wait(self, seconds: float) -> None:
        self.clock.now_s += seconds
        self.follower.maintain()

    @property
    def running(self) -> str:
        take = self.lab.takes.take
        return "" if take is None else take.name

    async def settled(self) -> None:
        await wait_until_async(lambda: not self.follower._tasks)

    async def names(self) -> list[str]:
        """Return the names of the takes when the disk has them all, the oldest first."""
        await self.settled()
        return sorted(take.name for take in (await self.lab.takes.list()).takes)


@asynccontextmanager
async def following(folder: Path, follow: str, **settings: Any) -> AsyncIterator[Followed]:
    clock = Clock()
    async with still_lab(folder, clock, follow=follow, **settings) as lab:
        yield Followed(lab, clock)


def frames_of(lab: RecordingLab, name: str) -> list[bytes]:
    messages = TakeReader(lab.path(f"{name}.lcmlog")).messages()
    return [message.message for message in messages if message.key in {"3d", "event"}]


@pytest.fixture
async def measured(tmp_path: Path) -> AsyncIterator[Followed]:
    async with following(tmp_path, "measurement") as followed:
        yield followed


async def test_each_measurement_has_a_take_from_its_first_frame_on(measured: Followed) -> None:
    """The first frame matters most, and two measurements are two takes."""
    names = []
    for _ in range(2):
        measured.show(True)
        names.append(measured.running)
        published = [measured.lab.publish() for _ in range(5)]
        measured.show(False, END_S - 0.1)
        assert measured.running == names[-1]
        measured.wait(0.2)
        assert measured.running == ""
        [name] = set(await measured.names()) - set(names[:-1])
        assert frames_of(measured.lab, name) == published
        names[-1] = name
    assert len(set(names)) == 2


@pytest.mark.parametrize(("gap", "gap_s"), [(None, LOST_S - 1), (False, END_S - 0.1)])
async def test_a_short_gap_does_not_split_a_take(measured: Followed, gap: bool | None, gap_s: float) -> None:
    """One movement in two files is hard to use."""
    measured.show(True)
    for _ in range(5):
        measured.show(gap, gap_s)
        measured.show(True)
    measured.wait(1000.0)
    assert measured.running
    assert len(await measured.names()) == 1
    measured.show(None, LOST_S + 0.1)  # a server that is switched off
    assert measured.running == ""


async def test_a_stopped_take_is_not_started_again_before_the_next_measurement(measured: Followed) -> None:
    """The user has stopped it on purpose."""
    measured.show(True)
    await measured.lab.takes.stop()
    measured.wait(1.0)
    measured.show(None)
    measured.show(True)
    assert measured.running == ""
    measured.show(False, END_S + 0.1)
    measured.show(True)
    assert measured.running


async def test_a_source_that_is_added_again_begins_anew(measured: Followed) -> None:
    """The measurement of the former source had its take; that of the new one has none yet."""
    measured.show(True)
    measured.lab.output.withdraw("lab")
    measured.lab.output.announce("lab")
    measured.show(True)
    assert measured.running


async def test_the_take_of_a_peer_goes_on(measured: Followed, caplog: pytest.LogCaptureFixture) -> None:
    """What a peer has started, only a peer stops."""
    caplog.set_level(logging.INFO)
    await measured.lab.takes.start("of a peer")
    measured.show(True)
    assert names(caplog.text, "'of a peer'", "already")
    measured.show(False, END_S + 0.1)
    assert measured.running == "of a peer"


async def test_a_take_that_cannot_start_is_tried_again(
    measured: Followed, caplog: pytest.LogCaptureFixture
) -> None:
    """It begins as soon as the disk allows; the log does not fill meanwhile."""
    folder = measured.lab.directory / "lab"
    folder.write_text("in the way")
    measured.show(True)
    await measured.settled()
    for _ in range(3):
        measured.wait(1.0)
        await measured.settled()
    [warning] = [record for record in caplog.records if "a take is not started" in record.message]
    assert warning.levelno == logging.WARNING
    folder.unlink()
    measured.lab.output.storage.disk.succeeded()
    measured.wait(1.0)
    assert len(await measured.names()) == 1


# Recordings ----------------------------------------------------------------------------------


async def test_a_take_follows_a_recording_under_the_same_name(tmp_path: Path) -> None:
    """Both files of a recording are found by one name, and the peer learns of each take."""
    async with still_lab(tmp_path, follow="recording") as lab:
        start = partial(lab.output.follow_recording, "lab", start=True)
        stop = partial(lab.output.follow_recording, "lab", start=False, name="")
        assert await start(name="walk") == {"take": "walk"}
        published = lab.publish()
        assert await stop() == {"take": "walk"}
        assert frames_of(lab, "walk") == [published]
        assert await stop() == {}
        assert await start(name="walk") == {"take": "walk-2"}
        assert names((await start(name="run"))["take_problem"], "'walk-2'", "'lab'", "already")
        await lab.takes.stop()
        await lab.takes.start("of a peer")
        assert await stop() == {}
        assert lab.is_recording()


@pytest.mark.parametrize("setting", ["none", "measurement"])
async def test_without_the_setting_no_take_follows_a_recording(tmp_path: Path, setting: str) -> None:
    """Nothing is recorded that was not asked for."""
    async with still_lab(tmp_path, follow=setting) as lab:
        assert await lab.output.follow_recording("lab", start=True, name="walk") == {}
        assert not lab.is_recording()


# Events --------------------------------------------------------------------------------------


def event_message(*ids: int) -> bytes:
    message = rtc3d.events_t()
    message.num_events = len(ids)
    for event_id in ids:
        message.events.append(rtc3d.event_t())
        message.events[-1].id = event_id
    encoded: bytes = message.encode()
    return encoded


async def test_events_start_and_stop_takes(tmp_path: Path) -> None:
    """The events that start and stop a take are in it; the ids are unsigned."""
    async with following(tmp_path, "events", start_event_id=5, stop_event_id=0xFFFF_FFFE) as followed:
        publisher = followed.lab.publishers["event"]
        assert publisher.wanted
        publisher.publish(event_message(7))
        publisher.publish(event_message(-2))
        assert followed.running == ""
        start, both = event_message(7, 5), event_message(5, 9)
        publisher.publish(start)
        publisher.publish(both)
        assert followed.running
        stop = event_message(9, -2)
        publisher.publish(stop)
        publisher.publish(event_message(7))
        assert followed.running == ""
        [name] = await followed.names()
        assert frames_of(followed.lab, name) == [start, both, stop]


async def test_a_message_with_both_events_is_a_take_by_itself(tmp_path: Path) -> None:
    """Two events in one frame must not be lost between two takes."""
    async with following(tmp_path, "events", start_event_id=5, stop_event_id=6) as followed:
        message = event_message(5, 6)
        followed.lab.publishers["event"].publish(message)
        assert followed.running == ""
        [name] = await followed.names()
        assert frames_of(followed.lab, name) == [message]


async def test_one_event_can_start_and_stop_in_turns(tmp_path: Path) -> None:
    """A remote control with one button."""
    async with following(tmp_path, "events", start_event_id=5, stop_event_id=5) as followed:
        for is_running in (True, False, True, False):
            followed.lab.publishers["event"].publish(event_message(5))
            assert bool(followed.running) is is_running
            await asyncio.sleep(0)
        assert len(await followed.names()) == 2


def test_the_ids_of_events_are_read_from_a_message() -> None:
    """They are read without decoding each message."""
    for message, ids in (
        (component_message(LONG_EVENTS), [0x123456, 2]),
        (event_message(), []),
        (event_message(-1), [0xFFFF_FFFF]),
    ):
        assert event_ids(message) == ids
