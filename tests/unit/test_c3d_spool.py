import os
import re
import threading
import time
from pathlib import Path

import pytest

from gateway.c3d_spool import Spool
from gateway.errors import SpoolError


def spool_in(folder: Path, max_files: int = 100, max_bytes: int = 1_000_000) -> Spool:
    return Spool(folder / "c3d", max_files, max_bytes)


def test_a_file_is_kept_whole_under_its_source_and_time(tmp_path: Path) -> None:
    spool = spool_in(tmp_path)
    path = spool.store("lab", b"content")
    assert re.fullmatch(r"lab-\d{8}T\d{6}\.\d{6}Z\.c3d", path.name)
    assert path.read_bytes() == b"content"
    assert list(spool.directory.iterdir()) == [path]
    assert spool.newest("lab") == path


def test_the_newest_is_the_one_stored_last(tmp_path: Path) -> None:
    spool = spool_in(tmp_path)
    *_, last = [spool.store("lab", content) for content in (b"1", b"2", b"3")]
    assert spool.newest("lab") == last
    assert spool_in(tmp_path).newest("lab") == last  # after a restart, too


def test_sources_are_kept_apart_though_one_name_begins_another(tmp_path: Path) -> None:
    spool = spool_in(tmp_path)
    lab = spool.store("lab", b"lab")
    lab_2 = spool.store("lab-2", b"lab-2")
    assert spool.newest("lab") == lab
    assert spool.newest("lab-2") == lab_2
    assert spool.newest("la") is None


def test_without_a_folder_there_is_nothing(tmp_path: Path) -> None:
    assert spool_in(tmp_path).newest("lab") is None


def test_the_oldest_file_goes_first_when_there_are_too_many(tmp_path: Path) -> None:
    spool = spool_in(tmp_path, max_files=3)
    paths = [spool.store(source, b"x") for source in ("lab", "hall", "lab", "hall", "attic")]
    assert sorted(spool.directory.iterdir()) == sorted(paths[2:])


def test_the_oldest_file_goes_first_when_they_are_too_large(tmp_path: Path) -> None:
    spool = spool_in(tmp_path, max_bytes=10)
    paths = [spool.store("lab", bytes(size)) for size in (4, 3, 3, 1)]
    assert sorted(spool.directory.iterdir()) == paths[1:]
    last = spool.store("lab", bytes(10))
    assert list(spool.directory.iterdir()) == [last]


def test_a_file_larger_than_the_limit_for_all_files_is_refused(tmp_path: Path) -> None:
    spool = spool_in(tmp_path, max_bytes=10)
    before = spool.store("lab", bytes(10))
    with pytest.raises(SpoolError, match=r"of 11 bytes from lab is not stored: spool\.max_bytes is 10"):
        spool.store("lab", bytes(11))
    assert list(spool.directory.iterdir()) == [before]


def test_files_of_other_programs_are_left_alone(tmp_path: Path) -> None:
    spool = spool_in(tmp_path, max_files=1, max_bytes=10)
    spool.directory.mkdir()
    others = [
        spool.directory / name for name in ("walk 1.c3d", "lab.c3d", "20200101.c3d", "notes.part", "a.txt")
    ]
    for path in others:
        path.write_bytes(bytes(100))
        os.utime(path, (0, 0))
    kept = spool.store("lab", b"x")
    assert sorted(spool.directory.iterdir()) == sorted([*others, kept])
    assert spool.newest("lab") == kept


def test_unfinished_files_of_a_killed_gateway_are_deleted(tmp_path: Path) -> None:
    spool = spool_in(tmp_path)
    spool.directory.mkdir()
    old, new = spool.directory / "tmpold.c3d.part", spool.directory / "tmpnew.c3d.part"
    for path in (old, new):
        path.touch()
    two_hours_ago = time.time() - 7200
    os.utime(old, (two_hours_ago, two_hours_ago))
    kept = spool.store("lab", b"x")
    assert sorted(spool.directory.iterdir()) == sorted([kept, new])


def test_a_folder_that_cannot_be_created_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "c3d").write_text("a file where the folder should be")
    with pytest.raises(SpoolError, match=r"from lab cannot be stored in .*/c3d: .*spool\.directory"):
        spool_in(tmp_path).store("lab", b"x")


def test_a_disk_error_leaves_no_incomplete_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    spool = spool_in(tmp_path)
    with pytest.raises(SpoolError, match="No space left on device"):
        spool.store("lab", b"x")
    assert list(spool.directory.iterdir()) == []


def test_a_file_that_cannot_be_deleted_is_logged_and_the_new_file_is_stored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    spool = spool_in(tmp_path, max_files=1)
    old = spool.store("lab", b"old")

    def refuse(_path: Path) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(Path, "unlink", refuse)
    new = spool.store("lab", b"new")
    assert sorted(spool.directory.iterdir()) == [old, new]
    assert f"cannot delete the old file {old}: Operation not permitted" in caplog.text


def test_threads_that_store_files_at_the_same_time_keep_to_the_limit(tmp_path: Path) -> None:
    spool = spool_in(tmp_path, max_files=3)
    threads = [
        threading.Thread(target=lambda name=name: [spool.store(name, b"x") for _ in range(20)])
        for name in ("a", "b", "c", "d")
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(list(spool.directory.iterdir())) == 3
