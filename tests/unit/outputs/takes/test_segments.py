"""The last seconds, kept in segments and saved by links; the clock is the test's, so hours take no time."""

import errno
import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import pytest

from gateway.errors import QueryError
from gateway.outputs.takes import segments
from gateway.outputs.takes.disk import Disk
from gateway.outputs.takes.folder import TakesFolder
from gateway.outputs.takes.segments import RollingSegments, Save
from gateway.outputs.takes.take_file import SourceFacts
from gateway.runtime.losses import Losses
from gateway.takes.files.description import SourceDescription, TakeDetails
from gateway.takes.files.event_log import EventLogReader
from gateway.takes.files.reader import TakeReader
from gateway.takes.files.writer_thread import LogFile
from tests.support.clocks import Clock
from tests.support.errors import names, raises
from tests.support.recording_output import frames, still_lab
from tests.support.records import logged

CHANNEL = b"MOCAP_LAB_3D"


def message(number: int) -> bytes:
    """Return a message with this ``utime``."""
    return bytes(8) + number.to_bytes(8, "big") + b"content"


def numbers(path: Path) -> list[int]:
    """Return the numbers of the messages in a take, or in one of its files."""
    return [event.utime for event in TakeReader(path).events() if event.channel == CHANNEL.decode()]


class Rolling:
    """The rolling segments of a source that sends message 0, 1, 2, … at each second of the clock."""

    def __init__(self, folder: Path, keep_s: float = 60.0) -> None:
        self.takes = folder / "lab"
        self.clock = Clock()
        self.disk = Disk()
        self.path = folder / ".rolling" / "lab"
        losses = Losses(logging.getLogger("gateway"), "lab to takes")
        self.segments = RollingSegments(
            self.path,
            keep_s,
            SourceFacts(SourceDescription("lab", "MOCAP_LAB"), None, self.disk, losses),
            self.clock,
        )
        self.num_messages = 0

    def write(self, num_messages: int) -> None:
        """Write the next messages; the clock stands at the next second afterwards."""
        for _ in range(num_messages):
            self.segments.write([(CHANNEL, message(self.num_messages))])
            self.num_messages += 1
            self.clock.now_s += 1.0

    def save(self, last_s: float, name: str = "fall", *, goes_on: bool = False) -> Save:
        """Save the last seconds."""
        return self.segments.save(
            self.takes / name, self.clock() - last_s, has_free_name=False, goes_on=goes_on
        )

    @property
    def files(self) -> list[Path]:
        """The segments on the disk, the oldest first."""
        return sorted(self.path.glob("*"))


@pytest.fixture(autouse=True)
def _quick_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hours of segments are hundreds of files, and no test needs them after a power failure."""
    monkeypatch.setattr(os, "fsync", lambda _descriptor: None)


@pytest.fixture
def rolling(tmp_path: Path) -> Rolling:
    return Rolling(tmp_path)


def test_for_hours_what_is_kept_is_the_last_minute_rounded_up_to_a_segment(rolling: Rolling) -> None:
    """Less would break the promise of keep_last_s, and more would fill the disk."""
    for _ in range(30):
        rolling.write(7)
        kept = [number for path in rolling.files for number in numbers(path)]
        assert kept == list(range(kept[0], rolling.num_messages))
    for _ in range(360):
        rolling.write(1)
        rolling.clock.now_s += 9
        assert 60 <= rolling.segments.kept_s() <= 80
        assert len(rolling.files) <= 9


@pytest.mark.parametrize(
    ("last_s", "first"),
    [(0.5, 30), (4.9, 30), (5, 20), (5.1, 20), (14.9, 20), (15.1, 10), (25.1, 0), (1e9, 0)],
)
def test_a_saved_take_begins_with_the_segment_of_its_time(
    rolling: Rolling, last_s: float, first: int
) -> None:
    """A segment that ends after the beginning has wanted messages, even if it begins long before."""
    rolling.write(35)
    rolling.save(last_s)
    assert numbers(rolling.takes / "fall") == list(range(first, 35))


def test_a_saved_take_has_lost_what_its_segments_have_lost_and_is_cut_off_without_their_ends(
    rolling: Rolling,
) -> None:
    folder = TakesFolder(rolling.takes.parent)
    for num_lost in (5, 3, 1):
        rolling.write(1)
        rolling.segments.num_refused += num_lost
        rolling.write(9)
    rolling.save(5)
    fall = folder.take_at(rolling.takes / "fall")
    assert (fall.num_lost, fall.is_cut_off) == (1, False)
    rolling.write(1)
    save = rolling.save(1e9, "all", goes_on=True)
    [cut_off] = (take for take in folder.takes("lab", ()) if take.name == "all")
    assert (cut_off.num_lost, cut_off.is_cut_off) == (9, True)
    [running] = (take for take in folder.takes("lab", {"all"}) if take.name == "all")
    assert not running.is_cut_off
    rolling.segments.end_save(save)
    assert not folder.take_at(rolling.takes / "all").is_cut_off


def test_a_saved_take_ends_at_once_and_its_segments_are_shared(rolling: Rolling) -> None:
    """What comes later is in a new segment, and no byte is copied."""
    rolling.write(25)
    save = rolling.save(60)
    rolling.write(1)
    logs = sorted(save.folder.iterdir())
    assert [path.name for path in logs] == [f"fall-00{number}.lcmlog" for number in (1, 2, 3)]
    assert [path.stat().st_ino for path in logs] == [path.stat().st_ino for path in rolling.files[:3]]
    assert [numbers(path) for path in rolling.files] == [
        *([*range(10)], [*range(10, 20)], [*range(20, 25)], [25])
    ]
    for log in logs:
        assert next(EventLogReader(log).events()).channel == "MOCAP_LAB_TAKE"


def test_what_a_saved_take_is_about_is_in_a_first_file_of_its_own(rolling: Rolling) -> None:
    """Segments are shared between takes, so nothing can be added to them; times must not go back, though."""
    rolling.write(25)
    about = TakeDetails("S01", note="fell")
    save = rolling.segments.save(rolling.takes / "fall", 0.0, about, has_free_name=False, goes_on=False)
    first, second, *_ = sorted(save.folder.iterdir())
    assert first.name == "fall-000.lcmlog"
    utimes = [event.utime for path in (first, second) for event in EventLogReader(path).events()]
    assert utimes == sorted(utimes)
    take = TakesFolder(rolling.takes.parent).take_at(save.folder)
    assert (take.details, take.is_cut_off, take.num_lost) == (about, False, 0)
    assert numbers(save.folder) == [*range(25)]


def test_takes_that_go_on_get_each_segment_until_their_end(rolling: Rolling) -> None:
    """Two takes that overlap have the same segments, and each ends at its own time."""
    rolling.write(5)
    first = rolling.save(60, "first", goes_on=True)
    rolling.write(20)
    second = rolling.save(1, "second", goes_on=True)
    rolling.write(12)
    rolling.segments.end_save(first)
    rolling.write(3)
    rolling.segments.end_save(first)  # again, which must not end the present segment
    rolling.write(3)
    rolling.segments.end_save(second)
    rolling.write(30)
    assert numbers(first.folder) == list(range(37))
    assert numbers(second.folder) == list(range(20, 43))
    assert [numbers(path)[0] for path in rolling.files] == [0, 10, 20, 30, 37, 43, 53, 63]


def test_a_save_outlives_its_segments(rolling: Rolling) -> None:
    """Deleting what has expired, and the end of the gateway, leave what was saved."""
    rolling.write(15)
    ended = rolling.save(60, "ended")
    rolling.save(60, "going on", goes_on=True)
    rolling.write(300)
    rolling.disk.failed(rolling.path, OSError(28, "No space left on device"))
    rolling.segments.close()
    assert not rolling.disk.problem  # whether it persists is not known
    rolling.segments.close()
    assert numbers(ended.folder) == list(range(15))
    assert numbers(rolling.takes / "going on") == list(range(315))
    assert not rolling.path.exists()


@pytest.mark.parametrize(("keep_s", "length"), [(5.0, 10), (60.0, 10), (3600.0, 10), (7200.0, 20)])
def test_segments_are_longer_if_there_would_be_too_many(tmp_path: Path, keep_s: float, length: int) -> None:
    """Each take that is saved has a link to each segment, so their number is limited."""
    rolling = Rolling(tmp_path, keep_s)
    rolling.write(length + 1)
    assert [numbers(path) for path in rolling.files] == [[*range(length)], [length]]


def test_keeping_less_deletes_at_once(rolling: Rolling) -> None:
    """A user who lowers keep_last_s wants the room now, and not with the next segment."""
    rolling.write(55)
    rolling.segments.keep(15.0)
    assert [numbers(path)[0] for path in rolling.files] == [30, 40, 50]
    rolling.write(20)
    assert [numbers(path)[0] for path in rolling.files] == [50, 60, 70]


@pytest.mark.parametrize(("complete", "left"), [(0, 1), (1, 1), (2, 2), (5, 3)])
def test_making_room_deletes_the_older_half(rolling: Rolling, complete: int, left: int) -> None:
    """The present segment stays; of the others, half and at least one must go, or the disk stays full."""
    rolling.write(10 * complete + 1)
    before = rolling.files
    assert rolling.segments.shorten() is bool(complete)
    assert rolling.files == before[-left:]


def test_a_take_has_at_most_the_number_of_files_that_names_allow(
    rolling: Rolling, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A take that goes on for hours ends with a warning, in good order, and the segments go on."""
    monkeypatch.setattr(segments, "_MAX_FILES", 3)
    rolling.write(1)
    save = rolling.save(60, goes_on=True)
    rolling.write(60)
    assert numbers(save.folder) == list(range(30))
    assert [(each.level, *each.args) for each in logged(caplog)] == [("WARNING", save.folder, 3)]


def no_links(*_arguments: object, **_options: object) -> NoReturn:
    raise PermissionError(1, "Operation not permitted")


def test_a_save_that_fails_leaves_nothing(rolling: Rolling, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half a take under the wanted name would be taken for a whole one."""
    rolling.write(15)
    with monkeypatch.context() as patch:
        patch.setattr(os, "link", no_links)
        with pytest.raises(PermissionError):
            rolling.save(60)
    assert not (rolling.takes / "fall").exists()
    rolling.save(60)
    assert numbers(rolling.takes / "fall") == list(range(15))


def test_a_segment_that_cannot_be_linked_is_a_problem(
    rolling: Rolling, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The recording goes on without it, and the user learns why a part is missing."""
    rolling.write(10)
    save = rolling.save(60, goes_on=True)
    with monkeypatch.context() as patch:
        patch.setattr(os, "link", no_links)
        rolling.segments.log_for(10)  # begins another segment
    assert names(rolling.disk.problem, save.folder, "Operation not permitted")
    rolling.write(20)
    assert not rolling.disk.problem
    oldest = rolling.files[0]
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", no_links)
        rolling.segments.shorten()
    assert names(rolling.disk.problem, oldest)
    assert numbers(save.folder) == [*range(30)]  # it was linked at its end


@pytest.mark.parametrize("end", ["of the take", "of the gateway", "of the numbers for its files"])
def test_a_saved_take_counts_what_could_not_be_linked(
    rolling: Rolling, monkeypatch: pytest.MonkeyPatch, end: str
) -> None:
    """A take with a hole must not look whole, however it ends."""
    rolling.write(10)
    save = rolling.save(60, goes_on=True)
    with monkeypatch.context() as patch:
        patch.setattr(os, "link", no_links)
        rolling.write(20)
    rolling.write(10)
    assert numbers(save.folder) == [*range(10), *range(20, 40)]
    match end:
        case "of the take":
            rolling.segments.end_save(save)
        case "of the gateway":
            rolling.segments.close()
        case _:
            monkeypatch.setattr(segments, "_MAX_FILES", 4)
            rolling.write(20)
    assert TakesFolder(rolling.takes.parent).take_at(save.folder).num_lost == 10


@pytest.mark.parametrize(("place", "left"), [(0, [*range(10, 25)]), (-1, [*range(20), *range(22, 25)])])
def test_a_segment_that_is_removed_costs_only_itself(rolling: Rolling, place: int, left: list[int]) -> None:
    """The others are saved, and messages do not go on into a file that has no name."""
    rolling.write(22)
    rolling.segments.sync()
    rolling.files[place].unlink()
    rolling.segments.sync()  # finds that the present one is gone
    rolling.write(3)
    rolling.save(60)
    assert numbers(rolling.takes / "fall") == left
    taken = TakesFolder(rolling.takes.parent).take_at(rolling.takes / "fall")
    assert (taken.num_lost, taken.is_cut_off) == (25 - len(left), False)


@pytest.mark.parametrize("goes_on", [False, True])
def test_a_segment_that_is_removed_just_before_it_is_saved_is_counted(
    rolling: Rolling, goes_on: bool
) -> None:
    """Nobody has noticed yet that the present one is gone; details are in the file with the number, too."""
    rolling.write(12)
    for path in rolling.files[1:]:
        path.unlink()
    details = TakeDetails("S01")
    save = rolling.segments.save(rolling.takes / "fall", 0, details, has_free_name=False, goes_on=goes_on)
    rolling.write(3)
    rolling.segments.end_save(save)
    taken = TakesFolder(rolling.takes.parent).take_at(save.folder)
    assert (taken.num_lost, taken.is_cut_off, taken.details) == (2, False, details)
    assert numbers(save.folder) == [*range(10), *([12, 13, 14] if goes_on else [])]


def test_what_was_removed_cannot_be_saved(rolling: Rolling) -> None:
    """An empty folder would look like a take."""
    rolling.write(12)
    for path in rolling.files:
        path.unlink()
    with pytest.raises(FileNotFoundError):
        rolling.save(60)
    assert not (rolling.takes / "fall").exists()


def test_a_name_that_is_taken_gets_a_number_or_is_refused(rolling: Rolling) -> None:
    """A take is never mixed with another one, be that a folder or a file."""
    rolling.takes.mkdir()
    (rolling.takes / "fall-2.lcmlog").touch()
    rolling.write(1)
    free = [
        rolling.segments.save(rolling.takes / "fall", 0.0, has_free_name=True, goes_on=False).name
        for _ in range(3)
    ]
    assert free == ["fall", "fall-3", "fall-4"]
    for name in ("fall", "fall-2"):
        with raises(QueryError, f"'{name}'"):
            rolling.save(60, name)


def test_nothing_can_be_saved_before_the_first_message(rolling: Rolling) -> None:
    """The peer learns that it is too early; an empty take would look like a loss."""
    assert rolling.segments.kept_s() == 0.0
    with raises(QueryError, code="nothing-yet"):
        rolling.save(60)
    rolling.write(3)
    assert rolling.segments.kept_s() == 3.0


def test_a_disk_that_fails_ends_the_seconds_that_can_be_saved(rolling: Rolling) -> None:
    """Who saves the last minute after an accident must not be promised what was never written."""
    rolling.write(5)
    rolling.disk.failed(rolling.path, OSError(errno.EIO, "Input/output error"))
    rolling.clock.now_s += 100.0
    assert rolling.segments.kept_s() == 4.0


# A full disk ---------------------------------------------------------------------------------


class SmallDisk:
    """Lets all logs below a folder together have ``num_bytes``."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.num_bytes = 10**9

        def append(log: LogFile, messages: Sequence[tuple[bytes, bytes]]) -> int:
            used = sum(path.stat().st_size for path in folder.rglob("*.lcmlog"))
            if used + sum(28 + len(channel) + len(message) for channel, message in messages) > self.num_bytes:
                raise OSError(errno.ENOSPC, "No space left on device")
            return original(log, messages)

        original = LogFile.append
        monkeypatch.setattr(LogFile, "append", append)


@pytest.fixture
def small_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SmallDisk:
    return SmallDisk(tmp_path, monkeypatch)


def test_on_a_full_disk_the_oldest_segments_make_room_for_new_ones(
    rolling: Rolling, small_disk: SmallDisk
) -> None:
    rolling.write(35)
    small_disk.num_bytes = sum(path.stat().st_size for path in rolling.files)
    rolling.write(40)
    kept = [number for path in rolling.files for number in numbers(path)]
    assert kept == list(range(kept[0], 75))
    assert (rolling.segments.num_lost, rolling.disk.problem) == (0, "")
    assert 15 <= rolling.segments.kept_s() <= 35


def test_room_is_made_by_what_has_expired_before_anything_else(rolling: Rolling) -> None:
    """What has expired goes anyway; beyond it, each segment is a part of the promised last seconds."""
    rolling.write(35)
    rolling.clock.now_s += 36.0  # the first segment ended 61 s ago
    left = []
    while rolling.segments.delete_less_important():
        left.append([numbers(path)[0] for path in rolling.files])
    assert left == [[10, 20, 30], [20, 30], [30]]


def test_without_any_segment_to_delete_new_messages_are_lost_at_once_and_counted(
    rolling: Rolling, small_disk: SmallDisk
) -> None:
    """If they waited, they would hold up running takes, and take the room that is made later."""
    rolling.write(5)
    small_disk.num_bytes = 0
    rolling.write(40)
    assert rolling.segments.num_lost == 41  # with the message whose place the end of the segment should take
    assert "No space left on device" in rolling.disk.problem
    assert rolling.segments.kept_s() == 0  # the only segment is deleted, in vain
    small_disk.num_bytes = 10**9
    rolling.write(3)
    assert rolling.disk.problem == ""
    assert [number for path in rolling.files for number in numbers(path)] == [45, 46, 47]


async def test_a_running_take_gets_the_room_of_the_segments(tmp_path: Path, small_disk: SmallDisk) -> None:
    clock = Clock()
    async with still_lab(tmp_path, clock, keep_last_s=60) as lab:
        for _ in range(5):
            lab.publish(size=10_000)
            await lab.output.storage.written()
            clock.now_s += 11
        await lab.takes.start("walk")
        small_disk.num_bytes = sum(path.stat().st_size for path in lab.directory.rglob("*.lcmlog"))
        published = [lab.publish(size=2000) for _ in range(8)]
        stopped = await lab.takes.stop()
        assert frames(lab.path("walk.lcmlog")) == published
        assert (stopped.num_lost, stopped.is_cut_off) == (0, False)
