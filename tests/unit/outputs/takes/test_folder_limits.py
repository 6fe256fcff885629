"""The limits of the folder of takes: which are deleted first, and when the folder is checked."""

import logging
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.outputs.takes.disk import FolderWatch, Host
from gateway.outputs.takes.folder import ROLLING, TakesFolder
from gateway.outputs.takes.folder_clock import FILE
from tests.support.clocks import Clock
from tests.support.errors import names
from tests.support.recording_output import NoThread, settings_in
from tests.unit.outputs.takes.test_folder import NOW_S, stored

DAY_S = 86_400.0


@pytest.fixture
def takes(tmp_path: Path) -> TakesFolder:
    return TakesFolder(tmp_path)


def watch_of(takes: TakesFolder, clock: Clock | None = None, wall: Clock | None = None) -> FolderWatch:
    return FolderWatch(settings_in(takes.directory), Host(clock or Clock(), wall or Clock(NOW_S)))


def excess(takes: TakesFolder, max_bytes: int, *protected: str) -> int:
    """Apply a limit; return how many bytes are still too many."""
    paths = {takes.directory / name for name in protected}
    return watch_of(takes).delete_old(max_bytes, None, paths)


def left(
    takes: TakesFolder,
    max_bytes: int,
    *protected: str,
    max_age_s: float | None = None,
    watch: FolderWatch | None = None,
) -> list[str]:
    """Apply the limits; return the takes that are left, as SOURCE/NAME."""
    paths = {takes.directory / name for name in protected}
    (watch or watch_of(takes)).delete_old(max_bytes, max_age_s, paths)
    return sorted(f"{entry.source}/{entry.path.name}" for entry in takes.entries())


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
    assert excess(takes, 500, "lab/running") == 200
    assert excess(takes, 700, "lab/running") == 0


@pytest.mark.parametrize(("age_s", "is_kept"), [(4.9, True), (5.1, False)])
def test_a_take_that_was_just_written_is_not_deleted(takes: TakesFolder, age_s: float, is_kept: bool) -> None:
    """It may have been started after the running takes were noted."""
    stored(takes.directory / "lab/fresh.lcmlog", 1000, age_s)
    assert ("lab/fresh" in left(takes, 0, "lab/other")) is is_kept


def test_takes_are_deleted_by_age_unless_they_are_running(takes: TakesFolder) -> None:
    """max_age_days holds for the newest take of a source, too, but never for one that is running."""
    stored(takes.directory / FILE, 0, 0)
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
    assert excess(takes, 1150) == 0
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
    assert excess(takes, 399) == 0
    kept = {"newest.lcmlog", "walk.c3d", "notes.txt"}
    assert {path.name for path in lab.iterdir()} == {"a.lcmlog", "a.c3d", "a-3.c3d", *kept}
    deleted = f"deleted {lab}/a-2, the oldest one: the folder has 450 bytes, and takes.max_bytes is 399"
    assert deleted in caplog.text
    excess(takes, 150)
    assert {path.name for path in lab.iterdir()} == kept


def test_a_corrected_clock_makes_no_take_old(tmp_path: Path) -> None:
    """A computer without a battery writes takes in 1970 until it has found a time server."""
    wall, clock = Clock(1000.0), Clock()
    takes = TakesFolder(tmp_path)
    watch = watch_of(takes, clock, wall)
    assert left(takes, 1000, max_age_s=DAY_S, watch=watch) == []
    stored(tmp_path / "lab/walk.lcmlog", 1, NOW_S - wall())
    assert left(takes, 1000, max_age_s=DAY_S, watch=watch) == ["lab/walk"]
    wall.now_s = NOW_S
    clock.now_s += DAY_S - 1
    assert left(takes, 1000, max_age_s=DAY_S, watch=watch) == ["lab/walk"]
    clock.now_s += 2
    assert left(takes, 1000, max_age_s=DAY_S, watch=watch) == []


def test_takes_of_a_clock_that_was_behind_are_not_old_after_a_restart(takes: TakesFolder) -> None:
    """Without a battery, a computer goes on at the time of its last shutdown until it finds a time server."""
    clock, wall = Clock(), Clock(NOW_S - 10 * DAY_S)
    watch = watch_of(takes, clock, wall)
    left(takes, 10**6, max_age_s=DAY_S, watch=watch)
    take = stored(takes.directory / "lab/new.lcmlog", 1, 10 * DAY_S)
    copied = stored(takes.directory / "lab/copied.lcmlog", 1, 20 * DAY_S)
    left(takes, 10**6, max_age_s=DAY_S, watch=watch)
    for step_s in (0, 10 * DAY_S, 3650 * DAY_S, -3650 * DAY_S, 0):  # the clock may also be wrong for a moment
        clock.now_s += 100
        wall.now_s += step_s + 100
        assert left(takes, 10**6, max_age_s=DAY_S, watch=watch) == ["lab/copied", "lab/new"]
    assert take.stat().st_mtime == NOW_S
    assert copied.stat().st_mtime == NOW_S - 20 * DAY_S
    for each in (clock, wall):
        each.now_s += 4000
    left(takes, 10**6, max_age_s=DAY_S, watch=watch)
    assert left(takes, 10**6, max_age_s=DAY_S, watch=watch_of(takes, clock, wall)) == ["lab/new"]


@pytest.mark.parametrize("ahead_s", [2 * DAY_S, 30 * DAY_S, 3650 * DAY_S])
def test_a_clock_that_is_ahead_at_the_start_deletes_nothing(takes: TakesFolder, ahead_s: float) -> None:
    """One start with a wrong date must not cost all takes, neither before nor after a correction."""
    for age_s in (100, 200, 3 * DAY_S):
        stored(takes.directory / f"lab/{age_s:g}.lcmlog", 1, age_s)
    wall, clock = Clock(NOW_S + ahead_s), Clock()
    watch = watch_of(takes, clock, wall)
    young = ["lab/100", "lab/200"]
    for after_s in (0, 1, 1800, 1700):
        clock.now_s += after_s
        wall.now_s += after_s
        assert left(takes, 10**6, max_age_s=DAY_S, watch=watch) == young
    stored(takes.directory / "lab/new.lcmlog", 1, -ahead_s)  # a take with the wrong date proves nothing
    assert left(takes, 10**6, max_age_s=DAY_S, watch=watch) == [*young, "lab/new"]
    assert left(takes, 10**6, max_age_s=DAY_S, watch=watch_of(takes, clock, wall)) == [*young, "lab/new"]
    wall.now_s -= ahead_s
    assert left(takes, 10**6, max_age_s=DAY_S, watch=watch) == [*young, "lab/new"]


@pytest.mark.parametrize(("days", "is_kept"), [(30, False), (32, True)])
def test_after_an_hour_the_clock_is_believed_unless_it_is_ahead_by_more_than_a_month(
    takes: TakesFolder, caplog: pytest.LogCaptureFixture, days: float, is_kept: bool
) -> None:
    """After holidays, old takes are deleted; after years, a person has to say that the clock is right."""
    stored(takes.directory / FILE, 0, days * DAY_S)
    stored(takes.directory / "lab/old.lcmlog", 1, (days + 0.5) * DAY_S)
    clock, wall = Clock(), Clock(NOW_S)
    watch = watch_of(takes, clock, wall)
    assert left(takes, 10**6, max_age_s=DAY_S, watch=watch) == ["lab/old"]
    for each in (clock, wall):
        each.now_s += 3601
    for _ in range(2):
        assert left(takes, 10**6, max_age_s=DAY_S, watch=watch) == ["lab/old"] * is_kept
    assert len(caplog.records) == is_kept
    os.utime(takes.directory / FILE, (NOW_S, NOW_S))
    assert left(takes, 10**6, max_age_s=DAY_S, watch=watch) == []


def test_a_restart_before_the_clock_is_corrected_makes_no_take_old(takes: TakesFolder) -> None:
    """The folder knows that its clock is behind, and dates what is recorded meanwhile."""
    stored(takes.directory / FILE, 0, 0)
    clock, wall = Clock(), Clock(NOW_S - 30 * DAY_S)
    watch = watch_of(takes, clock, wall)
    left(takes, 10**6, max_age_s=DAY_S, watch=watch)
    take = stored(takes.directory / "lab/new.lcmlog", 1, 30 * DAY_S)
    for _ in range(4):
        left(takes, 10**6, max_age_s=DAY_S, watch=watch)
        for each in (clock, wall):
            each.now_s += 1000
    assert take.stat().st_mtime == NOW_S
    assert left(takes, 10**6, max_age_s=DAY_S) == ["lab/new"]


def test_nobody_knows_the_age_of_a_take_from_before_there_was_a_gateway(takes: TakesFolder) -> None:
    """It was written while the clock was not set, and the gateway ended before that was corrected."""
    stored(takes.directory / FILE, 0, 0)
    stored(takes.directory / "lab/1970.lcmlog", 1, NOW_S - 1000)
    stored(takes.directory / "lab/2020.lcmlog", 1, NOW_S - 1_577_836_801)
    assert left(takes, 10**6, max_age_s=DAY_S) == ["lab/1970"]


def test_a_time_of_the_folder_that_is_ahead_makes_no_take_old(takes: TakesFolder) -> None:
    """A clock that is ahead by less than a month may have been believed before it was corrected."""
    stored(takes.directory / FILE, 0, -20 * DAY_S)
    stored(takes.directory / "lab/new.lcmlog", 1, 100)
    assert left(takes, 10**6, max_age_s=DAY_S) == ["lab/new"]


def test_what_is_recorded_now_is_newer_than_takes_from_the_future(takes: TakesFolder) -> None:
    """Otherwise, each new take would be deleted before them."""
    stored(takes.directory / "lab/future.lcmlog", 1000, -9e8)
    clock = Clock()
    watch = watch_of(takes, clock)
    left(takes, 10**6, watch=watch)
    stored(takes.directory / "lab/new.lcmlog", 1000, 0)
    left(takes, 10**6, watch=watch)
    clock.now_s += 10
    assert left(takes, 1000, watch=watch) == ["lab/new"]


def test_takes_from_the_future_make_room_for_new_ones(takes: TakesFolder) -> None:
    """After an empty battery, all takes are newer than the clock; a new one must not end as "folder full"."""
    for name, age_s in (("a", -9e8), ("b", -2.0), ("c", -1e6)):
        stored(takes.directory / f"lab/{name}.lcmlog", 1000, age_s)
    clock, wall = Clock(), Clock(NOW_S)
    watch = watch_of(takes, clock, wall)
    left(takes, 10**6, watch=watch)
    running = stored(takes.directory / "lab/running.lcmlog", 1000, 0)
    clock.now_s += 10
    assert left(takes, 3000, "lab/running", watch=watch) == ["lab/a", "lab/b", "lab/running"]
    stored(running, 2000, 0)
    assert left(takes, 2000, "lab/running", watch=watch) == ["lab/b", "lab/running"]  # b may be new
    stored(takes.directory / "lab/d.lcmlog", 1000, 0)
    assert left(takes, 4000, "lab/running", watch=watch) == ["lab/b", "lab/d", "lab/running"]
    for each in (clock, wall):
        each.now_s += 10
    assert left(takes, 3000, watch=watch) == ["lab/d", "lab/running"]


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
        self.watch = FolderWatch(self.settings, Host(self.clock, Clock(NOW_S), lambda _name: self.thread))
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
    assert names(watched.watch.problem, "another gateway", tmp_path)
    former.close()
    assert former.open() == f"{tmp_path} is closed"  # a late check must not lock it again
    assert watched.check() == 2
    assert watched.watch.problem == ""


def test_a_disk_that_does_not_respond_is_a_problem(watched: Watched) -> None:
    """A network drive that hangs makes no error; only the time shows it."""
    assert names(watched.watch.problem, "checked yet")
    watched.check()
    watched.thread.age_s = 4.9
    assert watched.watch.problem == ""
    watched.thread.age_s = 5.1
    assert names(watched.watch.problem, "respond")


def test_the_limits_of_the_settings_are_applied(tmp_path: Path) -> None:
    """Days and bytes mean what they say."""
    watched = Watched(tmp_path, max_age_days=2, max_bytes=1024 * 1024)
    stored(tmp_path / FILE, 0, 0)
    old = stored(tmp_path / "lab/a.lcmlog", 10, 2.1 * DAY_S)
    new = stored(tmp_path / "lab/b.lcmlog", 1024 * 1024 + 5, 1.9 * DAY_S)
    watched.check()
    assert (old.exists(), new.exists(), watched.watch.excess_bytes) == (False, True, 5)
    watched.watch.close()
