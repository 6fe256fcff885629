"""The folder of takes: what a list has, reading, C3D files, and what a killed gateway has left."""

import os
from pathlib import Path

import pytest

from gateway.errors import QueryError
from gateway.outputs.takes.folder import MAX_PIECE_BYTES, ROLLING, StoredTake, TakesFolder, add_c3d
from tests.support.errors import names, raises
from tests.support.takes import encode_event
from tests.unit.outputs.takes.test_segments import no_links

NOW_S = 1_700_000_000.0


@pytest.fixture
def takes(tmp_path: Path) -> TakesFolder:
    return TakesFolder(tmp_path)


def stored(path: Path, content: bytes | int, age_s: float = 1000.0) -> Path:
    """Create a file that was written last so long ago."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(bytes(content) if isinstance(content, int) else content)
    os.utime(path, (NOW_S - age_s, NOW_S - age_s))
    return path


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
    stored(lab / "walk.lcmlog", log(2_000_000, 3_500_000, 4_000_000), 48)  # another one of the same size
    assert takes.take_at(lab / "walk").seconds == 2.0
    stored(lab / "long.lcmlog", log(*range(0, 10**9, 10**6)))  # is measured by its end
    assert takes.take_at(lab / "long").seconds == 999.0
    with raises(QueryError, "removed"):
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
    with raises(QueryError, "'lab'", "'evil'"):
        takes.read("lab", "evil", 0)
    assert takes.entries("lab") == takes.entries() == []


def test_a_take_of_more_than_999_files_is_read_in_their_order(takes: TakesFolder) -> None:
    """As text, fall-1000 comes before fall-101."""
    for number in (1000, 101, 999):
        stored(takes.directory / f"lab/fall/fall-{number:03}.lcmlog", log(number))
    assert takes.read("lab", "fall", 0).content == log(101) + log(999) + log(1000)


def test_what_a_killed_gateway_has_left_behind_becomes_a_take(takes: TakesFolder) -> None:
    """The last seconds before a crash may be the most interesting ones."""
    for number in (2, 1):
        stored(takes.directory / ROLLING / "lab" / f"x-00000{number}.lcmlog", log(number))
    takes.recover()
    [take] = (takes.directory / "lab").iterdir()
    assert [path.read_bytes() for path in sorted(take.iterdir())] == [log(1), log(2)]
    assert not (takes.directory / ROLLING / "lab").exists()


def test_a_lock_that_somebody_deletes_is_taken_again(tmp_path: Path) -> None:
    """Otherwise, another gateway could lock a new file of that name, and both would delete segments."""
    folder, other = TakesFolder(tmp_path), TakesFolder(tmp_path)
    assert folder.open() == ""
    for path in tmp_path.iterdir():
        path.unlink()
    assert folder.open() == ""
    for _ in range(3):
        assert names(other.open(), "another gateway", tmp_path)
    lock = str(tmp_path / ".rtc3d-gateway.lock")
    open_files = [os.path.realpath(each) for each in Path("/proc/self/fd").iterdir()]
    assert open_files.count(lock) == 1  # a gateway that waits for days must not run out of descriptors
    folder.close()
    assert other.open() == ""
    other.close()
