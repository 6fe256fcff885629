"""The file of a recording while its disk is full."""

import os
import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gateway.recorder.file_sink import FileSink
from gateway.takes.event_log import EventLogReader
from gateway.takes.recording import LogFile
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


@pytest.fixture
def sink(tmp_path: Path) -> FileSink:
    return FileSink(LogFile(tmp_path / "walk.lcmlog"))


def written(sink: FileSink) -> list[tuple[bytes, bytes]]:
    reader = EventLogReader(sink.path)
    events = [(event.channel.encode(), event.message) for event in reader.events()]
    assert not reader.damage
    return events


def test_nothing_is_lost_if_the_disk_has_room_again(sink: FileSink) -> None:
    sent = messages(2000)
    with disk_of(700_000):
        thread = threading.Thread(target=sink.write, args=(sent,))
        thread.start()
        wait_until(lambda: sink.problem)
        assert sink.problem == f"{sink.path} cannot be written: File too large"
        assert 400_000 < len(written(sink)) * 1000 < 700_000
    thread.join(10)
    assert written(sink) == sent
    assert (sink.problem, sink.num_errors, sink.lost) == ("", 1, {})


def test_what_the_disk_does_not_accept_at_the_end_is_counted(sink: FileSink) -> None:
    sent = messages(2000)
    with disk_of(700_000):
        thread = threading.Thread(target=sink.write, args=(sent,))
        thread.start()
        wait_until(lambda: sink.problem)
        sink.give_up()
        thread.join(10)
    assert written(sink) == sent[: len(written(sink))]
    assert sink.lost == {CHANNEL: 2000 - len(written(sink))}
    assert sink.problem


def test_no_end_of_an_event_is_left_behind_if_the_disk_is_full(sink: FileSink) -> None:
    sink.give_up()
    with disk_of(100_500):  # not at the end of an event
        sink.write(messages(1))
        sink.write(messages(200))
    sink.write(messages(1))
    assert len(written(sink)) == 97  # 95 of the 200 fit


def test_each_period_without_room_counts_as_one_error(sink: FileSink) -> None:
    """The report says how often the disk failed, not how often it was tried."""
    for _ in range(2):
        with disk_of(100_000):
            sink.write(messages(0))
            thread = threading.Thread(target=sink.write, args=(messages(200),))
            thread.start()
            wait_until(lambda: sink.problem)
            for _ in range(3):
                sink._failed(OSError(28, "No space left on device"))
        thread.join(30)
        assert not sink.problem
    assert (sink.num_errors, sink.lost, sink.is_unsafe) == (2, {}, False)
