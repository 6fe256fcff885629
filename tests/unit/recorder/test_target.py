import re
from pathlib import Path

import pytest

from gateway.errors import TakeError
from gateway.recorder.target import Target


def test_a_file_gets_the_extension(tmp_path: Path) -> None:
    Target(tmp_path / "walk")
    Target(tmp_path / "run.lcmlog")
    assert {path.name for path in tmp_path.iterdir()} == {"walk.lcmlog", "run.lcmlog"}


@pytest.mark.parametrize(
    ("sources", "expected"),
    [
        (["lab"], "lab"),
        (["lab", "robot", "Hand-2"], r"lab\+robot\+Hand-2"),
        (["a", "b", "c", "d"], "4-sources"),
    ],
)
def test_a_name_in_a_folder_follows_the_sources(tmp_path: Path, sources: list[str], expected: str) -> None:
    first, second = (Target(tmp_path).open(sources).path.name for _ in range(2))
    assert re.fullmatch(expected + r"-\d{8}-\d{6}\.lcmlog", first)
    assert re.fullmatch(expected + r"-\d{8}-\d{6}(-2)?\.lcmlog", second)
    assert first != second


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("there.lcmlog", "there.lcmlog exists already, and nothing is overwritten"),
        ("there", "there.lcmlog exists already"),
        ("dangling.lcmlog", "exists already"),
        ("nowhere/walk.lcmlog", "there is no folder .*nowhere; create it first"),
        ("there.lcmlog/walk.lcmlog", "there.lcmlog/walk.lcmlog cannot be created: Not a directory"),
        ("walk.mcap", r"choose a name that ends with \.lcmlog, and convert it afterwards"),
        ("x" * 300, "cannot be created: File name too long"),
    ],
)
def test_what_cannot_be_a_new_file_is_an_error(tmp_path: Path, name: str, problem: str) -> None:
    (tmp_path / "there.lcmlog").write_bytes(b"precious")
    (tmp_path / "dangling.lcmlog").symlink_to("elsewhere")
    with pytest.raises(TakeError, match=problem):
        Target(tmp_path / name)
    assert (tmp_path / "there.lcmlog").read_bytes() == b"precious"
    assert {path.name for path in tmp_path.iterdir()} == {"there.lcmlog", "dangling.lcmlog"}


def test_a_file_that_remains_empty_is_removed_again(tmp_path: Path) -> None:
    target = Target(tmp_path / "walk.lcmlog")
    target.discard_empty()
    assert not [*tmp_path.iterdir()]


def test_a_file_with_messages_stays(tmp_path: Path) -> None:
    target = Target(tmp_path / "walk.lcmlog")
    target.open([]).append([(b"MOCAP_LAB_3D", bytes(40))])
    target.discard_empty()
    assert (tmp_path / "walk.lcmlog").stat().st_size == 28 + 12 + 40
