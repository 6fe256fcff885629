"""The folder of takes: which are deleted first, what a list has, and when the folder is checked."""

import logging
import os
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from gateway.errors import QueryError
from gateway.outputs.takes import folder as folder_module
from gateway.outputs.takes.control import MAX_PIECE_BYTES, StoredTake
from gateway.outputs.takes.disk import Host
from gateway.outputs.takes.folder import ROLLING, TakesFolder, add_c3d
from gateway.outputs.takes.folder_watch import FolderWatch
from gateway.takes.files.event_log import encode_event
from tests.recording_output import NoThread, settings_in
from tests.settable_clock import Clock
from tests.unit.outputs.takes.test_segments import no_links

NOW_S = 1_700_000_000.0
DAY_S = 86_400.0


@pytest.fixture
def takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> TakesFolder:
    monkeypatch.setattr(folder_module, "time", SimpleNamespace(time=lambda: NOW_S))
    return TakesFolder(tmp_path)


def stored(path: Path, content: bytes | int, age_s: float = 1000.0) -> Path:
    """Create a file that was written last so long ago."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(bytes(content) if isinstance(content, int) else content)
    os.utime(path, (NOW_S - age_s, NOW_S - age_s))
    return path


def left(takes: TakesFolder, max_bytes: int, *protected: str, max_age_s: float | None = None) -> list[str]:
    """Apply the limits; return the takes that are left, as SOURCE/NAME."""
    paths = {takes.directory / name for name in protected}
    takes.delete_old(max_bytes=max_bytes, max_age_s=max_age_s, protected=paths)
    return sorted(f"{entry.source}/{entry.path.name}" for entry in takes.entries())


# Limits --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("max_bytes", "expected"),
    [
        (4000, ["hall/c", "lab/a", "lab/b", "lab/d"]),
        (3999, ["hall/c", "lab/a", "lab/d"]),  # b is the oldest, though not the first by name
        (2999, ["hall/c", "lab/d"]),
        (0, ["hall/c", "lab/d"]),  # the newest of each source stays
    ],
)
def test_the_oldest_takes_are_deleted_first(takes: TakesFolder, max_bytes: int, expected: list[str]) -> None:
    """Deleting too much, or the newest take, would lose what the user has just recorded."""
    for name, age_s in (("lab/a", 300), ("lab/b", 400), ("hall/c", 200), ("lab/d", 100)):
        stored(takes.directory / f"{name}.lcmlog", 1000, age_s)
    assert left(takes, max_bytes) == expected


def test_what_is_still_too_much_is_returned(takes: TakesFolder) -> None:
    """By it, the running take ends before the disk is full."""
    stored(takes.directory / "lab/running.lcmlog", 700)
    stored(takes.directory / "lab/old.lcmlog", 1000)
    running = {takes.directory / "lab/running"}
    assert takes.delete_old(max_bytes=500, max_age_s=None, protected=running) == 200
    assert takes.delete_old(max_bytes=700, max_age_s=None, protected=running) == 0


@pytest.mark.parametrize(("age_s", "is_kept"), [(4.9, True), (5.1, False)])
def test_a_take_that_was_just_written_is_not_deleted(takes: TakesFolder, age_s: float, is_kept: bool) -> None:
    """It may have been started after the running takes were noted."""
    stored(takes.directory / "lab/fresh.lcmlog", 1000, age_s)
    assert ("lab/fresh" in left(takes, 0, "lab/other")) is is_kept


def test_takes_are_deleted_by_age_unless_they_are_running(takes: TakesFolder) -> None:
    """max_age_days holds for the newest take of a source, too, but never for one that is running."""
    for name, age_s in (("old", 2 * DAY_S + 1), ("running", 3 * DAY_S), ("new", 2 * DAY_S - 1)):
        stored(takes.directory / f"lab/{name}.lcmlog", 10, age_s)
    stored(takes.directory / "hall/old.lcmlog", 10, 5 * DAY_S)
    assert left(takes, 10**6, "lab/running", max_age_s=2 * DAY_S) == ["lab/new", "lab/running"]


def links(takes: TakesFolder, name: str, *segments: Path, age_s: float = 1000.0) -> None:
    """Save segments as a take; its age is theirs."""
    for number, segment in enumerate(segments, start=1):
        path = takes.directory / "lab" / name / f"{name}-{number:03}.lcmlog"
        path.parent.mkdir(parents=True, exist_ok=True)
        os.link(segment, path)
        os.utime(path, (NOW_S - age_s, NOW_S - age_s))


def test_files_with_several_names_count_once(takes: TakesFolder) -> None:
    """Deleting one of two takes that share their segments makes no room."""
    shared, own = (stored(takes.directory / "origin" / each, 1000) for each in ("1", "2"))
    links(takes, "first", shared, age_s=900)
    links(takes, "second", shared, age_s=900)
    links(takes, "third", own, age_s=100)
    stored(takes.directory / "hall/newest.lcmlog", 10, 50)
    shared.unlink()
    own.unlink()
    assert len(left(takes, 2010)) == 4
    assert left(takes, 2009) == ["hall/newest", "lab/third"]


def test_deleting_a_take_whose_segments_are_still_kept_makes_no_room(takes: TakesFolder) -> None:
    """The rolling segments have the same bytes: counting them as free would let the disk fill."""
    kept = stored(takes.directory / ROLLING / "lab" / "1.lcmlog", 1000)
    links(takes, "saved", kept, age_s=900)
    stored(takes.directory / "lab/other.lcmlog", 600, 500)
    stored(takes.directory / "lab/newest.lcmlog", 100, 100)
    assert takes.delete_old(max_bytes=1150, max_age_s=None, protected=set()) == 0
    assert [entry.path.name for entry in takes.entries()] == ["newest"]
    assert kept.exists()


def test_c3d_files_go_with_their_take_only(takes: TakesFolder, caplog: pytest.LogCaptureFixture) -> None:
    """The C3D files count and go with the take; what a user has put there stays."""
    caplog.set_level(logging.INFO)
    lab = takes.directory / "lab"
    # "a-2" is a take of its own, not the second C3D file of "a".
    for name, age_s in (("a-2", 900), ("a", 800), ("newest", 100)):
        stored(lab / f"{name}.lcmlog", 100, age_s)
    for name in ("a.c3d", "a-3.c3d", "a-2.c3d", "walk.c3d", "notes.txt"):
        stored(lab / name, 50)
    assert takes.delete_old(max_bytes=399, max_age_s=None, protected=set()) == 0
    kept = {"newest.lcmlog", "walk.c3d", "notes.txt"}
    assert {path.name for path in lab.iterdir()} == {"a.lcmlog", "a.c3d", "a-3.c3d", *kept}
    deleted = f"deleted {lab}/a-2, the oldest one: the folder has 450 bytes, and takes.max_bytes is 399"
    assert deleted in caplog.text
    takes.delete_old(max_bytes=150, max_age_s=None, protected=set())
    assert {path.name for path in lab.iterdir()} == kept


# Lists and pieces ----------------------------------------------------------------------------


def log(*utimes: int) -> bytes:
    return b"".join(encode_event(number, utime, b"C", bytes(1000)) for number, utime in enumerate(utimes))


def test_a_list_has_the_newest_take_first_with_its_time_and_length(takes: TakesFolder) -> None:
    """A saved take begins in its first file and ends in its last one, whatever the order on the disk."""
    lab = takes.directory / "lab"
    stored(lab / "walk.lcmlog", log(1_000_000, 3_500_000), 50)
    for number in (2, 1, 3):
        stored(lab / f"fall/fall-00{number}.lcmlog", log(number * 10**7, number * 10**7 + 5), 99)
    stored(lab / "empty.lcmlog", b"", 70)
    assert takes.takes("lab", {"walk"}) == [
        StoredTake("walk", len(log(1, 2)), 1_000_000, 2.5, is_running=True),
        StoredTake("empty", 0, 0, 0.0, is_cut_off=True),
        StoredTake("fall", 3 * len(log(1, 2)), 10_000_000, 20.000005),
    ]
    assert takes.take_at(lab / "fall").seconds == 20.000005
    stored(lab / "walk.lcmlog", log(1_000_000, 3_500_000, 4_000_000), 49)
    assert takes.take_at(lab / "walk").seconds == 3.0
    stored(lab / "long.lcmlog", log(*range(0, 10**9, 10**6)))  # is measured by its end
    assert takes.take_at(lab / "long").seconds == 999.0
    with pytest.raises(QueryError, match="somebody has removed it"):
        takes.take_at(lab / "wal")


@pytest.mark.parametrize("offset", [0, 1, 999, 1000, 1001, 2500, 3_000_999, 3_001_000, 10**9])
def test_the_files_of_a_saved_take_are_read_as_one(takes: TakesFolder, offset: int) -> None:
    """A peer that puts the pieces together has every byte once, in order."""
    sizes = (1000, 0, 1500, 3_000_000 - 1500)
    content = os.urandom(sum(sizes))
    start = 0
    for number, size in enumerate(sizes):
        stored(takes.directory / f"lab/fall/fall-{number:03}.lcmlog", content[start : start + size])
        start += size
    piece = takes.read("lab", "fall", offset)
    assert piece == ("fall", len(content), offset, content[offset : offset + MAX_PIECE_BYTES])


def test_a_c3d_file_gets_the_next_free_number(takes: TakesFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """No recording of the server replaces another one; without links, it is copied."""
    take = stored(takes.directory / "lab/walk.lcmlog", 1).with_suffix("")
    file = stored(takes.directory / "spool.c3d", b"c3d")
    names = [add_c3d(take, file).name for _ in range(3)]
    assert names == ["walk.c3d", "walk (2).c3d", "walk (3).c3d"]
    assert (takes.directory / "lab/walk (3).c3d").samefile(file)
    monkeypatch.setattr(os, "link", no_links)
    assert add_c3d(take, file).read_bytes() == b"c3d"


def test_a_further_c3d_file_is_not_that_of_another_take(takes: TakesFolder) -> None:
    """It would be deleted with take walk-2."""
    for name in ("walk", "walk-2"):
        stored(takes.directory / f"lab/{name}.lcmlog", 1)
        for _ in range(2):
            add_c3d(takes.directory / "lab" / name, stored(takes.directory / "spool.c3d", b"c3d"))
    files = {entry.path.name: [path.name for path, _ in entry.c3d_files] for entry in takes.entries()}
    assert {name: sorted(each) for name, each in files.items()} == {
        "walk": ["walk (2).c3d", "walk.c3d"],
        "walk-2": ["walk-2 (2).c3d", "walk-2.c3d"],
    }


@pytest.mark.parametrize("link", ["lab/evil.lcmlog", "lab/evil/1.lcmlog", "lab/evil", "lab"])
def test_no_peer_gets_a_file_outside_the_folder(takes: TakesFolder, tmp_path: Path, link: str) -> None:
    """Whoever can write into the folder could have the gateway send any file that it can read."""
    secret = stored(tmp_path.with_name("secret") / "lab/evil/1.lcmlog", log(1)).parents[2]
    stored(secret / "lab/evil.lcmlog", log(1))
    (takes.directory / link).parent.mkdir(parents=True, exist_ok=True)
    (takes.directory / link).symlink_to(secret / link)
    with pytest.raises(QueryError, match="has no take 'evil'"):
        takes.read("lab", "evil", 0)
    assert takes.entries("lab") == takes.entries() == []


def test_a_take_of_more_than_999_files_is_read_in_their_order(takes: TakesFolder) -> None:
    """As text, fall-1000 comes before fall-101."""
    for number in (1000, 101, 999):
        stored(takes.directory / f"lab/fall/fall-{number:03}.lcmlog", log(number))
    assert takes.read("lab", "fall", 0).content == log(101) + log(999) + log(1000)


def test_a_corrected_clock_makes_no_take_old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A computer without a battery writes takes in 1970 until it has found a time server."""
    now_s, clock = 1000.0, Clock()
    monkeypatch.setattr(folder_module, "time", SimpleNamespace(time=lambda: now_s))
    takes = TakesFolder(tmp_path, clock)
    assert left(takes, 1000, max_age_s=DAY_S) == []
    stored(tmp_path / "lab/walk.lcmlog", 1, NOW_S - now_s)
    assert left(takes, 1000, max_age_s=DAY_S) == ["lab/walk"]
    now_s = NOW_S
    clock.now_s += DAY_S - 1
    assert left(takes, 1000, max_age_s=DAY_S) == ["lab/walk"]
    clock.now_s += 2
    assert left(takes, 1000, max_age_s=DAY_S) == []


def test_what_a_killed_gateway_has_left_behind_becomes_a_take(takes: TakesFolder) -> None:
    """The last seconds before a crash may be the most interesting ones."""
    for number in (2, 1):
        stored(takes.directory / ROLLING / "lab" / f"x-00000{number}.lcmlog", log(number))
    takes.recover()
    [take] = (takes.directory / "lab").iterdir()
    assert [path.read_bytes() for path in sorted(take.iterdir())] == [log(1), log(2)]
    assert not (takes.directory / ROLLING / "lab").exists()


# When the folder is checked ------------------------------------------------------------------


class SlowThread(NoThread):
    """A thread whose present call takes ``age_s`` already."""

    age_s = 0.0

    @property
    def call_age_s(self) -> float:
        return self.age_s


class Watched:
    """A watched folder; each call of ``open`` takes a second by the clock."""

    def __init__(self, directory: Path, **settings: object) -> None:
        self.clock = Clock()
        self.thread = SlowThread("slow")
        self.settings = settings_in(directory, **settings)
        self.watch = FolderWatch(self.settings, Host(self.clock, lambda _name: self.thread))
        self.num_checks = 0
        self._open = self.watch.folder.open
        self.watch.folder.open = self._open_slowly  # type: ignore[method-assign]

    def _open_slowly(self) -> str:
        self.num_checks += 1
        self.clock.now_s += 1.0
        return self._open()

    def check(self, after_s: float = 0.0) -> int:
        """Ask for a check; return how many were made so far."""
        self.clock.now_s += after_s
        self.watch.check(self.settings, frozenset())
        return self.num_checks


@pytest.fixture
def watched(tmp_path: Path) -> Iterator[Watched]:
    watched = Watched(tmp_path)
    yield watched
    watched.watch.close()


def test_after_a_slow_check_the_disk_rests(watched: Watched) -> None:
    """With thousands of takes, a check every second would keep a disk busy."""
    assert [watched.check(), watched.check(49.9), watched.check(0.2), watched.check(1.0)] == [1, 1, 2, 2]
    assert watched.watch.is_checked


def test_after_a_problem_the_folder_is_checked_again_at_once(watched: Watched, tmp_path: Path) -> None:
    """The former gateway may just be ending; two that share a folder would delete each other's segments."""
    former = TakesFolder(tmp_path)
    assert former.open() == ""
    assert watched.check() == 1
    assert "another gateway records" in watched.watch.problem
    former.close()
    assert former.open() == f"{tmp_path} is closed"  # a late check must not lock it again
    assert watched.check() == 2
    assert watched.watch.problem == ""


def test_a_lock_that_somebody_deletes_is_taken_again(tmp_path: Path) -> None:
    """Otherwise, another gateway could lock a new file of that name, and both would delete segments."""
    folder, other = TakesFolder(tmp_path), TakesFolder(tmp_path)
    assert folder.open() == ""
    for path in tmp_path.iterdir():
        path.unlink()
    assert folder.open() == ""
    for _ in range(3):
        assert "another gateway records" in other.open()
    lock = str(tmp_path / ".rtc3d-gateway.lock")
    open_files = [os.path.realpath(each) for each in Path("/proc/self/fd").iterdir()]
    assert open_files.count(lock) == 1  # a gateway that waits for days must not run out of descriptors
    folder.close()
    assert other.open() == ""
    other.close()


def test_a_disk_that_does_not_respond_is_a_problem(watched: Watched) -> None:
    """A network drive that hangs makes no error; only the time shows it."""
    assert "is not checked yet" in watched.watch.problem
    watched.check()
    watched.thread.age_s = 4.9
    assert watched.watch.problem == ""
    watched.thread.age_s = 5.1
    assert "does not respond" in watched.watch.problem


def test_the_limits_of_the_settings_are_applied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Days and bytes mean what they say."""
    watched = Watched(tmp_path, max_age_days=2, max_bytes=1024 * 1024)
    monkeypatch.setattr(folder_module, "time", SimpleNamespace(time=lambda: NOW_S))
    old = stored(tmp_path / "lab/a.lcmlog", 10, 2.1 * DAY_S)
    new = stored(tmp_path / "lab/b.lcmlog", 1024 * 1024 + 5, 1.9 * DAY_S)
    watched.check()
    assert (old.exists(), new.exists(), watched.watch.excess_bytes) == (False, True, 5)
    watched.watch.close()
