"""The folder of C3D files: names, limits for each source, leftovers, and a disk that refuses."""

import errno
import fcntl
import os
import re
import threading
from datetime import UTC, datetime
from pathlib import Path

import pytest

from gateway.session.c3d_files.receiving import problem_of_c3d
from gateway.session.c3d_files.spool import Spool, StoredFile, UnfinishedFile
from tests.support.errors import names


class RefusedCall:
    """A call of the system that fails with this error."""

    def __init__(self, number: int) -> None:
        self._number = number

    def __call__(self, *_arguments: object, **_options: object) -> None:
        raise OSError(self._number, os.strerror(self._number))


@pytest.fixture
def spool(tmp_path: Path) -> Spool:
    return spool_in(tmp_path)


def spool_in(folder: Path, max_files: int = 100, max_bytes: int = 1_000_000) -> Spool:
    return Spool(folder / "c3d", max_files, max_bytes)


def store(spool: Spool, source: str, content: bytes) -> StoredFile:
    unfinished = spool.begin()
    unfinished.write(content)
    return spool.keep(source, unfinished)


def files_in(spool: Spool) -> list[Path]:
    return sorted(spool.directory.iterdir())


def test_a_file_is_kept_whole_under_its_source_and_time(spool: Spool) -> None:
    assert spool.newest("lab") is None
    spool.delete_abandoned()  # without a folder, too
    unfinished = spool.begin()
    for piece in (b"con", b"", b"tent"):
        unfinished.write(piece)
    assert spool.newest("lab") is None
    stored = spool.keep("lab", unfinished)
    assert re.fullmatch(r"lab-\d{8}T\d{6}\.\d{6}Z\.c3d", stored.path.name)
    assert stored == StoredFile(stored.path, 7)
    assert stored.path.read_bytes() == b"content"
    assert files_in(spool) == [stored.path]
    assert spool.newest("lab") == stored.path
    *_, last = [store(spool, "lab", content).path for content in (b"1", b"2", b"3")]
    assert spool.newest("lab") == last
    assert Spool(spool.directory, 100, 100).newest("lab") == last  # after a restart, too
    given_up = spool.begin()
    given_up.write(b"x")
    given_up.discard()
    assert len(files_in(spool)) == 4


def test_a_clock_that_is_set_back_changes_neither_the_order_nor_what_is_deleted(tmp_path: Path) -> None:
    spool = spool_in(tmp_path, max_files=2)
    spool.directory.mkdir()
    future = spool.directory / "lab-20990101T000000.000000Z.c3d"
    future.write_bytes(b"stored before the clock was set back")
    first = store(spool, "lab", b"1")
    assert first.path.name == "lab-20990101T000000.000001Z.c3d"
    second = store(spool, "lab", b"2")
    assert second.deleted == (future,)
    assert spool.newest("lab") == second.path


def test_sources_are_kept_apart_though_one_name_begins_another(tmp_path: Path) -> None:
    spool = spool_in(tmp_path, max_files=1)
    names = ("lab", "lab-2", "lab-20260102T030405.000006Z")
    paths = [store(spool, name, name.encode()).path for name in names]
    assert files_in(spool) == sorted(paths)
    for name, path in zip(names, paths, strict=True):
        assert spool.newest(name) == path
    assert spool.newest("la") is None


# Limits --------------------------------------------------------------------------------------


def test_the_oldest_files_of_the_source_go_first_when_there_are_too_many(tmp_path: Path) -> None:
    spool = spool_in(tmp_path, max_files=2)
    stored = [store(spool, source, b"x") for source in ("lab", "hall", "lab", "lab", "lab")]
    assert files_in(spool) == sorted(each.path for each in (stored[1], *stored[3:]))
    assert [each.deleted for each in stored[3:]] == [(stored[0].path,), (stored[2].path,)]


def test_the_oldest_files_of_the_source_go_first_when_they_are_too_large(tmp_path: Path) -> None:
    spool = spool_in(tmp_path, max_bytes=10)
    hall = store(spool, "hall", bytes(10)).path
    paths = [store(spool, "lab", bytes(size)).path for size in (4, 3, 3, 1)]
    assert files_in(spool) == sorted([hall, *paths[1:]])
    last = store(spool, "lab", bytes(10)).path
    assert files_in(spool) == sorted([hall, last])


def test_files_of_other_programs_are_left_alone(tmp_path: Path) -> None:
    spool = spool_in(tmp_path, max_files=1, max_bytes=10)
    spool.directory.mkdir()
    names = (
        "walk 1.c3d",
        "lab.c3d",
        "20200101.c3d",
        "notes.part",
        "a.txt",
        "lab-20260199T000000.000000Z.c3d",
    )
    others = [spool.directory / name for name in names]
    for path in others:
        path.write_bytes(bytes(100))
        os.utime(path, (0, 0))
    kept = store(spool, "lab", b"x").path
    assert files_in(spool) == sorted([*others, kept])
    assert spool.newest("lab") == kept


def test_only_regular_files_count(tmp_path: Path) -> None:
    """Opening a FIFO would block."""
    spool = spool_in(tmp_path, max_files=1)
    spool.directory.mkdir()
    for number in range(3):
        for name in (f"lab-20260102T030405.00000{number}Z.c3d", f"{number}.c3d.part"):
            path = spool.directory / name
            if number == 0:
                os.mkfifo(path)
            elif number == 1:
                path.mkdir()
            else:
                path.symlink_to("/dev/zero")
    assert spool.newest("lab") is None
    stored = store(spool, "lab", b"x")
    assert stored.problem == ""
    assert len(files_in(spool)) == 7


def test_threads_that_store_files_at_the_same_time_keep_to_the_limit(tmp_path: Path) -> None:
    spool = spool_in(tmp_path, max_files=3)
    threads = [
        threading.Thread(target=lambda name=name: [store(spool, name, b"x") for _ in range(20)])
        for name in ("a", "b", "c", "d")
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(files_in(spool)) == 4 * 3


# Unfinished files ----------------------------------------------------------------------------


def test_unfinished_files_of_a_killed_gateway_are_deleted(spool: Spool) -> None:
    spool.directory.mkdir()
    (spool.directory / "tmpkilled.c3d.part").write_bytes(b"x")
    in_progress = Spool(spool.directory, 1, 1).begin()  # of another gateway, or of another source
    kept = store(spool, "lab", b"x").path
    [_, unfinished] = files_in(spool)
    assert unfinished.name.endswith(".c3d.part")
    in_progress.write(b"y")
    other = spool.keep("hall", in_progress)
    assert files_in(spool) == sorted([kept, other.path])


# A disk that refuses -------------------------------------------------------------------------


def test_a_folder_that_cannot_be_created_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "c3d").write_text("a file where the folder should be")
    with pytest.raises(FileExistsError):
        spool_in(tmp_path).begin()
    with pytest.raises(NotADirectoryError):
        spool_in(tmp_path).newest("lab")


def test_a_folder_that_was_removed_meanwhile_loses_one_file(spool: Spool) -> None:
    unfinished = spool.begin()
    for path in files_in(spool):
        path.unlink()
    spool.directory.rmdir()
    with pytest.raises(FileNotFoundError):
        spool.keep("lab", unfinished)
    unfinished.discard()
    assert store(spool, "lab", b"x").path.read_bytes() == b"x"


def test_a_device_that_is_full_is_an_error(spool: Spool) -> None:
    unfinished = spool.begin()
    full = os.open("/dev/full", os.O_WRONLY)
    os.dup2(full, unfinished._descriptor)
    os.close(full)
    with pytest.raises(OSError, match="No space left") as caught:
        unfinished.write(b"x")
    assert caught.value.errno == errno.ENOSPC
    unfinished.discard()
    assert files_in(spool) == []


def test_a_folder_with_problems_stores_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spool = spool_in(tmp_path, max_files=1)
    old = store(spool, "lab", b"old").path
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", RefusedCall(errno.EPERM))
        new = store(spool, "lab", b"new")
    assert (new.num_bytes, new.deleted) == (3, ())
    assert names(new.problem, old, os.strerror(errno.EPERM))
    assert files_in(spool) == [old, new.path]
    with monkeypatch.context() as patch:
        patch.setattr(os, "scandir", RefusedCall(errno.EACCES))
        before = datetime.now(UTC)
        stored = store(spool, "lab", b"x")
    assert names(stored.problem, spool.directory, os.strerror(errno.EACCES))
    assert stored.path.read_bytes() == b"x"
    assert stored.path.name > f"lab-{before:%Y%m%dT%H%M%S.%f}"


def test_a_file_is_locked_while_it_is_written(tmp_path: Path) -> None:
    unfinished = UnfinishedFile(tmp_path)
    Spool(tmp_path, 1, 1).delete_abandoned()
    assert len([*tmp_path.iterdir()]) == 1
    os.close(unfinished._descriptor)  # what the end of a process does
    Spool(tmp_path, 1, 1).delete_abandoned()
    assert [*tmp_path.iterdir()] == []


def test_a_drive_without_locks_stores_files(spool: Spool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fcntl, "flock", RefusedCall(errno.ENOLCK))
    in_progress = spool.begin()
    assert store(spool, "lab", b"x").path.read_bytes() == b"x"
    in_progress.write(b"y")
    assert spool.keep("hall", in_progress).path.read_bytes() == b"y"


# Which files these are -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("head", "file_bytes", "problem"),
    [
        (b"\x02\x50", 1024, ""),
        (b"\x02\x50", 512, ""),
        (b"\x0a\x50", 5000, ""),
        (b"\xff\x50", 10**9, ""),
        (b"", 0, "empty"),
        (b"\x02\x50", 511, "511 bytes"),
        (b"\x02\x51", 1024, "first bytes"),
        (b"PK", 1024, "first bytes"),
        (b"\x00\x50", 1024, "parameters"),
        (b"\x01\x50", 1024, "parameters"),
        (b"\x04\x50", 1024, "parameters"),
    ],
)
def test_what_is_no_c3d_file_is_refused_with_a_reason(head: bytes, file_bytes: int, problem: str) -> None:
    found = problem_of_c3d(head, file_bytes)
    assert problem in found
    assert bool(found) == bool(problem)
