"""Files that have their names only when they are complete, all or none of them."""

import errno
import os
from pathlib import Path

import pytest

from gateway.errors import TakeError
from gateway.takes.files.new_file import NewFiles
from tests.support.errors import raises


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


def create(folder: Path, error: BaseException | None = None, *, appears: bool = False) -> None:
    """Write three files; fail, or let another program create the second one meanwhile."""
    with NewFiles() as files:
        for number in (1, 2, 3):
            files.create(folder / f"walk-{number}.c3d").write(b"x")
        if error is not None:
            raise error
        if appears:
            (folder / "walk-2.c3d").write_bytes(b"mine")


@pytest.mark.parametrize(
    ("error", "problem"),
    [
        (ValueError("defect"), "defect"),
        (KeyboardInterrupt("stop"), "stop"),
        (
            OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
            "walk-3.c3d cannot be written: No space left on device",
        ),
    ],
)
def test_an_error_leaves_none_of_several_files(tmp_path: Path, error: BaseException, problem: str) -> None:
    expected = TakeError if isinstance(error, OSError) else type(error)
    with pytest.raises(expected, match=problem):
        create(tmp_path, error)
    assert names(tmp_path) == set()


@pytest.mark.parametrize("target", ["file", "folder", "dangling link"])
def test_what_exists_is_not_replaced(tmp_path: Path, target: str) -> None:
    path = tmp_path / "walk-1.c3d"
    match target:
        case "file":
            path.write_bytes(b"mine")
        case "folder":
            path.mkdir()
        case _:
            path.symlink_to(tmp_path / "nowhere")
    with raises(TakeError, "walk-1.c3d", "exists already"):
        create(tmp_path)
    assert names(tmp_path) == {"walk-1.c3d"}


def test_a_file_that_appears_meanwhile_is_not_replaced_and_none_of_the_others_remains(tmp_path: Path) -> None:
    with raises(TakeError, "walk-2.c3d"):
        create(tmp_path, appears=True)
    assert names(tmp_path) == {"walk-2.c3d"}
    assert (tmp_path / "walk-2.c3d").read_bytes() == b"mine"


def test_a_folder_that_is_missing_is_a_clear_error(tmp_path: Path) -> None:
    with raises(TakeError, "nowhere/walk-1.c3d", tmp_path / "nowhere", "create"):
        create(tmp_path / "nowhere")


def test_a_file_system_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_links(*_: object) -> None:
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "link", no_links)
    (tmp_path / "other").mkdir()
    create(tmp_path / "other")
    assert names(tmp_path / "other") == {"walk-1.c3d", "walk-2.c3d", "walk-3.c3d"}
    with raises(TakeError, "walk-2.c3d"):
        create(tmp_path, appears=True)
    assert names(tmp_path) == {"other", "walk-2.c3d"}


def test_folders_are_removed_after_an_error_unless_others_use_them(tmp_path: Path) -> None:
    def create_folders() -> None:
        with NewFiles() as files:
            for folder in ("a", "a/b", "c"):
                files.create_folder(tmp_path / folder)
            files.create(tmp_path / "a/b/walk.tsv").write(b"x")
            (tmp_path / "c/mine").touch()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        create_folders()
    assert names(tmp_path) == {"c"}


def test_a_replaced_file_keeps_its_content_until_the_end(tmp_path: Path) -> None:
    table = tmp_path / "table.tsv"
    table.write_bytes(b"old")

    def stop() -> None:
        with NewFiles() as files:
            files.replace(table).write(b"new")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stop()
    assert table.read_bytes() == b"old"
    with NewFiles() as files:
        files.replace(table).write(b"new")
        assert table.read_bytes() == b"old"
    assert table.read_bytes() == b"new"
    assert names(tmp_path) == {"table.tsv"}


def test_a_locked_folder_is_free_when_the_block_ends(tmp_path: Path) -> None:
    with NewFiles() as files:
        files.lock_folder(tmp_path)
        with (
            NewFiles() as others,
            raises(TakeError, tmp_path),
        ):
            others.lock_folder(tmp_path)
    with NewFiles() as files:
        files.lock_folder(tmp_path)
