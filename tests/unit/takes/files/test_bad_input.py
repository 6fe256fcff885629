"""Files that are no takes, or not only takes: a clear error, or a report of what was left out."""

import os
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gateway.errors import TakeError
from gateway.rtc3d.parameters import Marker, Parameters, Parameters3D
from gateway.rtc3d.parameters_xml import encode_parameters
from gateway.takes import open_take
from gateway.takes.files.reader import TakeReader
from gateway.takes.files.statistics import take_statistics
from gateway.takes.files.take import Take
from tests.support.errors import raises
from tests.support.takes import description, log_bytes, markers, parameters, write_take

READERS: list[Callable[[Path], Any]] = [
    open_take,
    take_statistics,
    lambda path: list(TakeReader(path).messages()),
]


def huge_hole(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(100 * 1024**3)


def folder_of_others(path: Path) -> None:
    path.mkdir()
    (path / "notes.txt").touch()
    (path / "a.lcmlog").touch()


HUGE_CLAIM = bytes.fromhex("eda1da01") + bytes(16) + (4).to_bytes(4, "big") + (200_000_000).to_bytes(4, "big")
"""The header of an event with a message of 200 MB that is not there."""

OTHER_LOG = log_bytes((f"CAMERA_{number % 9}", bytes(50)) for number in range(100))
CHANNELS = "CAMERA_0, CAMERA_1, CAMERA_2, CAMERA_3, CAMERA_4, …"

NO_TAKES: dict[str, tuple[bytes | Callable[[Path], object], str]] = {
    "png": (
        b"\x89PNG\r\n\x1a\n" + random.Random(1).randbytes(100_000),
        "without an LCM event; choose a recording",
    ),
    "text": (b"time,x,y\n" * 10_000, "without an LCM event"),
    "c3d": (b"\x02\x50" + bytes(510) + random.Random(2).randbytes(51_200), "without an LCM event"),
    "sync words": (bytes.fromhex("eda1da01") * 10_000, "without an LCM event"),
    "huge hole": (huge_hole, "without an LCM event"),
    "huge claims": ((HUGE_CLAIM + b"NAME" + bytes(2000)) * 500, "without an LCM event"),
    "empty": (b"", "is empty"),
    "folder": (Path.mkdir, "has no recordings"),
    "folder of others": (folder_of_others, "is empty"),
    "pipe": (os.mkfifo, "it is a pipe"),
    "device": (lambda path: path.symlink_to("/dev/zero"), "it is a device"),
    "loop": (lambda path: path.symlink_to(path), "Too many levels of symbolic links"),
    "nothing": (lambda _path: None, "No such file"),
    "other log": (OTHER_LOG, f"100 messages of other types, on channel {CHANNELS}$"),
    "other version": (
        log_bytes([("MOCAP_LAB_3D", bytes(56))]),
        "on channel MOCAP_LAB_3D; they may be of another version of the gateway",
    ),
}


@pytest.mark.timeout(20)
@pytest.mark.parametrize("read", READERS, ids=["open_take", "take_statistics", "messages"])
@pytest.mark.parametrize("kind", NO_TAKES)
def test_what_is_no_take_is_a_clear_error(tmp_path: Path, kind: str, read: Callable[[Path], Any]) -> None:
    path, (content, message) = tmp_path / "take", NO_TAKES[kind]
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        content(path)
    with pytest.raises(TakeError, match=message) as raised:
        read(path)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize("name", ["a\0b", "a" * 300, "file/below"])
def test_odd_paths(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    with raises(TakeError, tmp_path.name):
        open_take(tmp_path / name)


def sequence(take: Take) -> list[int]:
    """Return the sequence numbers of the markers."""
    found = take.sources["lab"].markers
    assert found
    return [*map(int, found.sequence)]


def test_a_folder_is_read_without_its_empty_files(tmp_path: Path) -> None:
    write_take(tmp_path / "a-001.lcmlog", [markers(1, 0)])
    (tmp_path / "a-002.lcmlog").touch()
    write_take(tmp_path / "a-003.lcmlog", [markers(1, 1)])
    take, statistics = open_take(tmp_path), take_statistics(tmp_path)
    assert (sequence(take), take.num_damaged) == ([0, 1], 1)
    assert list(statistics.empty_files) == [tmp_path / "a-002.lcmlog"]
    assert not statistics.is_complete


def test_rotated_files_of_lcm_logger_are_read_in_the_order_of_their_times(tmp_path: Path) -> None:
    for number in range(3):  # with --rotate, the newest file is .0
        write_take(tmp_path / f"log.{2 - number}", [markers(1, number)])
    assert sequence(open_take(tmp_path)) == [0, 1, 2]


def test_a_log_that_grows_while_it_is_read_gives_what_was_complete(tmp_path: Path) -> None:
    path = write_take(tmp_path / "take.lcmlog", [markers(1, number) for number in range(3)])
    more = log_bytes([markers(1, 3)])
    messages = TakeReader(path).messages()
    read = [next(messages)]
    with path.open("ab") as file:
        file.write(more[:-1])
    read += messages
    assert [int.from_bytes(message.message[24:32], "big") for message in read] == [0, 1, 2]


def test_a_log_that_shrinks_while_it_is_read_ends(tmp_path: Path) -> None:
    path = write_take(tmp_path / "take.lcmlog", [markers(100, number) for number in range(3000)])
    messages = TakeReader(path).messages()
    next(messages)
    os.truncate(path, 2_000_000)
    assert 0 < sum(1 for _ in messages) < 3000


def test_labels_in_latin_1_keep_their_letters(tmp_path: Path) -> None:
    content = encode_parameters(Parameters(markers=Parameters3D(markers=(Marker("1", "Foot"),))))
    xml = "<?xml version='1.0' encoding='ISO-8859-1'?>" + content.decode().replace("Foot", "Fuß")
    messages = [parameters(xml.encode()), markers(1, 0)]
    found = open_take(write_take(tmp_path / "take.lcmlog", messages)).sources["lab"].markers
    assert found
    assert found.labels == ("Fuß",)


@pytest.mark.timeout(20)
def test_a_hole_of_any_size_in_a_log_is_skipped(tmp_path: Path) -> None:
    path = write_take(tmp_path / "take.lcmlog", [markers(1, 0)])
    size, hole = path.stat().st_size, 100 * 1024**3
    with path.open("r+b") as file:
        file.seek(hole)
        file.write(log_bytes([markers(1, 1)]))
        file.truncate(2 * hole)
    statistics = take_statistics(path)
    assert statistics.sources["lab"].components["3d"].num_messages == 2
    assert statistics.damaged_bytes == 2 * hole - 2 * size


def test_segments_that_were_joined_are_one_take(tmp_path: Path) -> None:
    start = [description(), parameters(Parameters(markers=Parameters3D(markers=(Marker("1", "a"),))))]
    first = log_bytes([*start, markers(1, 0), markers(1, 1)])
    (tmp_path / "take.lcmlog").write_bytes(first + log_bytes([*start, markers(1, 2)]))
    found = take_statistics(tmp_path / "take.lcmlog")
    source = found.sources["lab"]
    assert found.is_complete
    assert (source.components["3d"].num_messages, source.gateway_restarts) == (3, 0)
    assert source.parameters.num_changes == 1
    assert len(open_take(tmp_path / "take.lcmlog").sources["lab"].runs("3d")) == 1


MEASURE = """
import sys
from gateway.takes import open_take

def peak_bytes():
    lines = open("/proc/self/status").read().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))

open_take(sys.argv[2])  # imports what it needs
before = peak_bytes()
take = open_take(sys.argv[1])
assert take.sources["lab"].markers.items.shape == (12_000, 200)
print(peak_bytes() - before)
"""


def test_reading_needs_less_memory_than_twice_the_file(tmp_path: Path) -> None:
    small = write_take(tmp_path / "small.lcmlog", [markers(200, 0)])
    path = tmp_path / "take.lcmlog"
    path.write_bytes(log_bytes([markers(200, 0)]) * 12_000)
    peak = subprocess.check_output([sys.executable, "-c", MEASURE, path, small], text=True)
    assert int(peak) < 2 * path.stat().st_size
