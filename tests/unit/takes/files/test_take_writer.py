"""A take whose disk is full while it is written, or when it ends."""

import errno
import os
import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gateway.client.recorder import FileWriter
from gateway.takes.files.event_log import EventLogReader
from gateway.takes.files.take_writer import begin_log
from gateway.takes.files.writer_thread import LogFile
from tests.support.errors import names
from tests.support.waiting import wait_until

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
def writing(take: FileWriter, sent: list[tuple[bytes, bytes]]) -> Iterator[threading.Thread]:
    """Write in a thread to a disk with room for 700 kB in the block, and for all afterwards."""
    thread = threading.Thread(target=take.write, args=(sent,))
    with disk_of(take.num_bytes + 700_000):
        thread.start()
        wait_until(lambda: take.problem)
        yield thread
    thread.join(30)


@pytest.fixture
def take(tmp_path: Path) -> FileWriter:
    return FileWriter(LogFile(tmp_path / "walk.lcmlog"))


def written(take: FileWriter) -> list[tuple[bytes, bytes]]:
    reader = EventLogReader(take.path)
    events = [(event.channel.encode(), event.message) for event in reader.events()]
    assert not reader.damage
    return events


def test_nothing_is_lost_if_the_disk_has_room_again(take: FileWriter) -> None:
    """Each period without room counts as one error: how often it was tried does not matter."""
    sent = messages(2000)
    for number in (1, 2):
        with writing(take, sent):
            assert names(take.problem, take.path, os.strerror(errno.EFBIG))
            assert 400_000 < len(written(take)) * 1000 - 2_000_000 * (number - 1) < 700_000
            for _ in range(3):
                take.failed(OSError(28, "No space left on device"))
        assert written(take) == sent * number
        assert (take.problem, take.num_errors, take.lost, take.is_unsafe) == ("", number, {}, False)


def test_what_the_disk_does_not_accept_at_the_end_is_counted(take: FileWriter) -> None:
    sent = messages(2000)
    with writing(take, sent) as thread:
        take.give_up()
        thread.join(10)
    assert written(take) == sent[: len(written(take))]
    assert take.lost == {CHANNEL: 2000 - len(written(take))}
    assert take.problem


@pytest.mark.parametrize(("room_bytes", "num_kept"), [(100_000, 3), (3200, 2), (0, 2)])
def test_the_end_of_the_file_takes_the_place_of_a_message_on_a_full_disk(
    take: FileWriter, room_bytes: int, num_kept: int
) -> None:
    """So that a file that lacks messages says so; without room for an end, it counts as cut off."""
    sent = messages(3)
    take.write(sent)
    with disk_of(room_bytes):
        take.end_log(lambda num_removed: [(b"MOCAP_LAB_END", bytes(300) + bytes([num_removed]))])
    found = written(take)
    assert found[:num_kept] == sent[:num_kept]
    assert [message[-1] for _, message in found[num_kept:]] == {100_000: [0], 3200: [1], 0: []}[room_bytes]


def test_a_file_that_cannot_begin_is_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty file of that name would refuse the next attempt."""

    def write(_descriptor: int, _content: memoryview | None = None) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", write)
        patch.setattr(os, "fsync", write)  # closing fails, too
        with pytest.raises(OSError, match="No space left"):
            begin_log(tmp_path / "walk.lcmlog", messages(1))
    begin_log(tmp_path / "walk.lcmlog", messages(1)).close()
