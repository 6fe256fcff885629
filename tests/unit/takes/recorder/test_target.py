"""The file of a recording: its name, and what happens while its disk is full."""

import os
import re
import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gateway.errors import TakeError
from gateway.takes.files.event_log import EventLogReader
from gateway.takes.files.recording import LogFile
from gateway.takes.recorder.target import FileSink, Target
from tests.waiting import wait_until

CHANNEL = b"MOCAP_LAB_3D"


def messages(count: int) -> list[tuple[bytes, bytes]]:
    return [(CHANNEL, bytes(8) + number.to_bytes(8, "big") + os.urandom(984)) for number in range(count)]


@contextmanager
def disk_of(num_bytes: int) -> Iterator[None]:
    """Let no file become larger: the system then behaves as with a full disk (EFBIG)."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def writing(sink: FileSink, sent: list[tuple[bytes, bytes]]) -> Iterator[threading.Thread]:
    """Write in a thread to a disk with room for 700 kB in the block, and for all afterwards."""
    thread = threading.Thread(target=sink.write, args=(sent,))
    with disk_of(sink.num_bytes + 700_000):
        thread.start()
        wait_until(lambda: sink.problem)
        yield thread
    thread.join(30)


@pytest.fixture
def sink(tmp_path: Path) -> FileSink:
    return FileSink(LogFile(tmp_path / "walk.lcmlog"))


def written(sink: FileSink) -> list[tuple[bytes, bytes]]:
    reader = EventLogReader(sink.path)
    events = [(event.channel.encode(), event.message) for event in reader.events()]
    assert not reader.damage
    return events


def test_nothing_is_lost_if_the_disk_has_room_again(sink: FileSink) -> None:
    """Each period without room counts as one error: how often it was tried does not matter."""
    sent = messages(2000)
    for number in (1, 2):
        with writing(sink, sent):
            assert sink.problem == f"{sink.path} cannot be written: File too large"
            assert 400_000 < len(written(sink)) * 1000 - 2_000_000 * (number - 1) < 700_000
            for _ in range(3):
                sink._failed(OSError(28, "No space left on device"))
        assert written(sink) == sent * number
        assert (sink.problem, sink.num_errors, sink.lost, sink.is_unsafe) == ("", number, {}, False)


def test_what_the_disk_does_not_accept_at_the_end_is_counted(sink: FileSink) -> None:
    sent = messages(2000)
    with writing(sink, sent) as thread:
        sink.give_up()
        thread.join(10)
    assert written(sink) == sent[: len(written(sink))]
    assert sink.lost == {CHANNEL: 2000 - len(written(sink))}
    assert sink.problem


@pytest.mark.parametrize(("room_bytes", "num_kept"), [(100_000, 3), (3200, 2), (0, 2)])
def test_the_end_of_the_file_takes_the_place_of_a_message_on_a_full_disk(
    sink: FileSink, room_bytes: int, num_kept: int
) -> None:
    """So that a file that lacks messages says so; without room for an end, it counts as cut off."""
    sent = messages(3)
    sink.write(sent)
    with disk_of(room_bytes):
        sink.end(lambda num_removed: [(b"MOCAP_LAB_END", bytes(300) + bytes([num_removed]))])
    found = written(sink)
    assert found[:num_kept] == sent[:num_kept]
    assert [message[-1] for _, message in found[num_kept:]] == {100_000: [0], 3200: [1], 0: []}[room_bytes]


def test_no_end_of_an_event_is_left_behind_if_the_disk_is_full(sink: FileSink) -> None:
    sink.give_up()
    with disk_of(100_500):  # not at the end of an event
        sink.write(messages(1))
        sink.write(messages(200))
    sink.write(messages(1))
    assert len(written(sink)) == 97  # 95 of the 200 fit


# Its name ------------------------------------------------------------------------------------


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


def test_a_file_gets_the_extension_and_is_removed_if_it_remains_empty(tmp_path: Path) -> None:
    targets = [Target(tmp_path / name) for name in ("walk", "run.lcmlog", "full")]
    assert {path.name for path in tmp_path.iterdir()} == {"walk.lcmlog", "run.lcmlog", "full.lcmlog"}
    targets[2].open([]).append([(CHANNEL, bytes(40))])
    for target in targets:
        target.discard_empty()
    assert {path.name: path.stat().st_size for path in tmp_path.iterdir()} == {"full.lcmlog": 28 + 12 + 40}
