"""The limits of the folder of takes, its checks, and settings that change; the disk answers at once."""

from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest

from gateway.outputs.takes.disk import Host
from gateway.outputs.takes.folder import ROLLING, TakesFolder
from gateway.outputs.takes.output import TakesOutput
from gateway.takes.files.reader import log_paths
from tests.support.clocks import Clock
from tests.support.errors import names
from tests.support.recording_output import NoThread, RecordingLab, frames, settings_in, still_host, still_lab
from tests.support.takes import markers, write_take

MIB = 1024 * 1024


class FolderThread(NoThread):
    """The thread that checks the folder; while it ``is_stuck``, it makes no call."""

    is_stuck = False

    def submit(self, call: Callable[[], Any]) -> Future[Any]:
        return Future() if self.is_stuck else super().submit(call)


def host_with(folder_thread: FolderThread) -> Host:
    """Return a host without threads, where this one checks the folder."""

    def thread(name: str) -> NoThread:
        return folder_thread if name == "takes-folder" else NoThread(name)

    still = still_host(Clock())
    return Host(still.monotonic, still.wall, thread, still.writer)


async def test_a_take_ends_when_the_folder_is_full_and_nothing_can_be_deleted(tmp_path: Path) -> None:
    """Rather a take that ends in good order than a full disk; a take that is started then goes on."""
    folder_thread = FolderThread("takes-folder")
    lab = RecordingLab(tmp_path, host=host_with(folder_thread), max_bytes=MIB)
    lab.output.start()
    await lab.takes.start("walk")
    while lab.path("walk.lcmlog").stat().st_size <= MIB:
        lab.publish(size=1000)
        await lab.output.storage.written()
    lab.output.maintain()
    assert lab.is_recording()
    folder_thread.is_stuck = True
    lab.output.maintain()
    assert not lab.is_recording()
    [loss] = lab.takes.losses.report()
    assert (loss.cause, loss.messages, loss.frames) == ("folder full", 1, 0)
    assert names(loss.text, "walk", "takes.max_bytes")
    await lab.takes.start("run")
    lab.output.maintain()  # what was too much is known from before
    assert lab.is_recording()
    lab.output.close()


async def test_a_take_that_ends_because_the_folder_is_full_leaves_the_segments(tmp_path: Path) -> None:
    """Its end stops what has filled the folder; the last seconds are what is needed after such a surprise."""
    clock = Clock()
    async with still_lab(tmp_path, clock, keep_last_s=3600, max_bytes=MIB) as lab:
        await lab.takes.start("walk")
        for _ in range(4):
            for _ in range(10):
                lab.publish(size=1000)
            await lab.output.storage.written()
            clock.now_s += 10
        before = sorted((tmp_path / ROLLING / "lab").iterdir())
        lab.output.maintain()
        assert lab.is_recording()
        lab.output.maintain()
        assert not lab.is_recording()
        assert len(before) == 4
        assert sorted((tmp_path / ROLLING / "lab").iterdir()) == before


async def test_the_older_half_of_the_segments_makes_room_if_no_take_does(tmp_path: Path) -> None:
    """With long keep_last_s, the segments alone can be more than the limit."""
    clock = Clock()
    async with still_lab(tmp_path, clock, keep_last_s=3600, max_bytes=MIB) as lab:
        for _ in range(8):
            for _ in range(10):
                lab.publish(size=1000)
            await lab.output.storage.written()
            clock.now_s += 10
        segments = tmp_path / ROLLING / "lab"
        before = sorted(segments.iterdir())
        for _ in range(2):
            lab.output.maintain()
        assert sorted(segments.iterdir()) == before[4:]
        assert sum(path.stat().st_size for path in segments.iterdir()) <= MIB
        lab.output.maintain()
        assert sorted(segments.iterdir()) == before[4:]


@pytest.mark.parametrize(
    ("changes", "kept_s"),
    [
        ({"keep_last_s": 30.0}, 25.0),
        ({"keep_last_s": 10.0}, 15.0),
        ({"prefix": "HALL"}, 0.0),
        ({"components": ["event"]}, 0.0),
        ({"directory": "other"}, 0.0),
        ({"keep_last_s": 0.0}, 0.0),
    ],
)
async def test_a_reload_keeps_segments_that_fit(
    tmp_path: Path, changes: dict[str, Any], kept_s: float
) -> None:
    """The last seconds must survive a change of limits, but not be mixed with other channels."""
    clock = Clock()
    async with still_lab(tmp_path / "takes", clock, keep_last_s=60) as lab:
        for _ in range(25):
            lab.publish()
            await lab.output.storage.written()
            clock.now_s += 1
        before = [*(tmp_path / "takes" / ROLLING / "lab").iterdir()]
        if "directory" in changes:
            changes = {"directory": str(tmp_path / "other")}
        base = settings_in(tmp_path / "takes", keep_last_s=60)
        lab.output.take_over(TakesOutput(type(base).model_validate(base.model_dump() | changes)))
        await lab.output.storage.written()
        other = TakesFolder(tmp_path / "takes")
        assert (other.open() == "") is ("directory" in changes)  # nobody else may use a folder that is in use
        other.close()
        assert (await lab.takes.list()).kept_s == kept_s
        assert all(not path.exists() for path in before) is (kept_s == 0.0)
        lab.publish("event")
        await lab.output.storage.written()
        folders = [tmp_path / "takes" / ROLLING / "lab", tmp_path / "other" / ROLLING / "lab"]
        num_segments = sum(len(log_paths(folder)) for folder in folders if folder.exists())
        assert (num_segments > 0) is (changes.get("keep_last_s") != 0.0)


async def test_a_reload_is_applied_if_anything_has_changed(tmp_path: Path) -> None:
    """The log says whether a reload did anything; the poses are asked for by this output."""
    async with still_lab(tmp_path) as lab:
        for has_tool_poses, is_change in ((False, False), (True, True), (True, False), (False, True)):
            other = TakesOutput(settings_in(tmp_path, tool_poses=has_tool_poses))
            assert lab.output.take_over(other) is is_change
            assert lab.output.has_tool_poses is has_tool_poses


async def test_the_segments_of_a_killed_gateway_are_listed_after_the_start(tmp_path: Path) -> None:
    """Nobody would find them in a hidden folder, and the next segments would be mixed with them."""
    (tmp_path / ROLLING / "lab").mkdir(parents=True)
    segment = write_take(tmp_path / ROLLING / "lab" / "x-000001.lcmlog", [markers(1)])
    async with still_lab(tmp_path, keep_last_s=60) as lab:
        assert [take.is_running for take in (await lab.takes.list()).takes] == [False]
        assert not segment.exists()


@pytest.mark.parametrize("was_there", [True, False])
async def test_the_segments_on_a_disk_that_is_mounted_later_are_kept(tmp_path: Path, was_there: bool) -> None:
    """A slow disk may come after the gateway; the seconds before a power failure are on it."""
    directory, disk = tmp_path / "takes", tmp_path / "disk"
    if not was_there:
        directory.write_text("no folder")
    for source in ("lab", "hall"):
        (disk / ROLLING / source).mkdir(parents=True)
        write_take(disk / ROLLING / source / "x-000001.lcmlog", [markers(1)])
    async with still_lab(directory, keep_last_s=60) as lab:
        if was_there:
            lab.publish()
            lab.output.storage.started_writer().call(lambda: None)
        directory.rename(tmp_path / "below")
        disk.rename(directory)  # what is mounted there hides the former folder
        assert lab.takes.segments is not None
        lab.takes.segments.sync()
        newest = lab.publish()
        lab.output.storage.started_writer().call(lambda: None)
        for _ in range(3):
            lab.output.maintain()
        [recovered] = (await lab.takes.list()).takes
        assert [*lab.path(recovered.name).iterdir()]
        assert len([*(directory / "hall").iterdir()]) == 1
        saved = await lab.takes.save(60, name="saved")
        assert frames(lab.path("saved"))[-1] == newest  # this gateway's own segment stays
        assert saved.num_lost == was_there


async def test_a_take_can_start_before_the_folder_was_checked(tmp_path: Path) -> None:
    """A measurement may begin with the gateway; creating the file shows whether the disk works."""
    folder_thread = FolderThread("takes-folder")
    folder_thread.is_stuck = True
    lab = RecordingLab(tmp_path, host=host_with(folder_thread))
    lab.output.start()
    assert not lab.output.health().connected
    assert (await lab.takes.start("walk")).is_running
    lab.output.close()


async def test_running_takes_are_not_deleted_however_old_they_are(tmp_path: Path) -> None:
    """A take whose server pauses for a day is still being written."""
    clock = Clock()
    async with still_lab(tmp_path, clock, max_age_days=1, keep_last_s=60) as lab:
        lab.publish()
        await lab.takes.start("walk")
        await lab.takes.save(60, 600, "fall")
        lab.output.maintain()
        clock.now_s += 3 * 86_400
        lab.output.maintain()
        assert lab.path("walk.lcmlog").exists()
        assert [*lab.path("fall").iterdir()]
        await lab.takes.stop()
        lab.output.maintain()
        clock.now_s += 3 * 86_400
        lab.output.maintain()
        assert not lab.path("walk.lcmlog").exists()
