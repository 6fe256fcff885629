import errno
import os
from pathlib import Path

import pytest

from gateway.errors import TakeError
from gateway.takes.new_file import NewFiles


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_file_has_its_name_only_when_it_is_complete(tmp_path: Path) -> None:
    with NewFiles() as files:
        files.create(tmp_path / "walk.csv").write(b"complete")
        assert "walk.csv" not in names(tmp_path)
        assert {Path(name).suffix for name in names(tmp_path)} == {".csv"}
    assert names(tmp_path) == {"walk.csv"}
    assert (tmp_path / "walk.csv").read_bytes() == b"complete"
    assert files.paths == [tmp_path / "walk.csv"]


def create_and_fail(paths: list[Path], error: BaseException) -> None:
    with NewFiles() as files:
        for path in paths:
            files.create(path).write(b"x")
        raise error


@pytest.mark.parametrize("error", [ValueError("defect"), KeyboardInterrupt()])
def test_an_error_leaves_none_of_several_files(tmp_path: Path, error: BaseException) -> None:
    with pytest.raises(type(error)):
        create_and_fail([tmp_path / "walk-1.c3d", tmp_path / "walk-2.c3d"], error)
    assert names(tmp_path) == set()


@pytest.mark.parametrize("target", ["file", "folder", "dangling link"])
def test_what_exists_is_not_replaced(tmp_path: Path, target: str) -> None:
    path = tmp_path / "walk.c3d"
    match target:
        case "file":
            path.write_bytes(b"mine")
        case "folder":
            path.mkdir()
        case _:
            path.symlink_to(tmp_path / "nowhere")
    with (
        pytest.raises(TakeError, match=r"walk.c3d exists already.*nothing is overwritten"),
        NewFiles() as files,
    ):
        files.create(path)
    assert names(tmp_path) == {"walk.c3d"}


def create_while_another_appears(folder: Path) -> None:
    with NewFiles() as files:
        files.create(folder / "walk-1.c3d").write(b"x")
        files.create(folder / "walk-2.c3d").write(b"x")
        (folder / "walk-2.c3d").write_bytes(b"mine")


def test_a_file_that_appears_meanwhile_is_not_replaced_and_none_of_the_others_remains(tmp_path: Path) -> None:
    with pytest.raises(TakeError, match="exists already"):
        create_while_another_appears(tmp_path)
    assert names(tmp_path) == {"walk-2.c3d"}
    assert (tmp_path / "walk-2.c3d").read_bytes() == b"mine"


def test_a_folder_that_is_missing_is_a_clear_error(tmp_path: Path) -> None:
    with (
        pytest.raises(TakeError, match=r"nowhere/walk.c3d cannot be written: No such file"),
        NewFiles() as files,
    ):
        files.create(tmp_path / "nowhere/walk.c3d")


def test_a_full_disk_is_a_clear_error_and_leaves_no_file(tmp_path: Path) -> None:
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(TakeError, match=r"walk.c3d cannot be written: No space left on device"):
        create_and_fail([tmp_path / "walk.c3d"], full)
    assert names(tmp_path) == set()


def test_a_file_system_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_links(*_: object) -> None:
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "link", no_links)
    with NewFiles() as files:
        files.create(tmp_path / "walk.csv").write(b"complete")
    assert names(tmp_path) == {"walk.csv"}
    with pytest.raises(TakeError, match="exists already"):
        create_while_another_appears(tmp_path)
    assert names(tmp_path) == {"walk.csv", "walk-2.c3d"}
