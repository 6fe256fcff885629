"""Recording: the queue before the disk, and a log whose disk takes a part of what is written."""

import errno
import os
from collections.abc import Sequence
from pathlib import Path

import pytest

from gateway.messages.history import utime_of
from gateway.takes.files.event_log import EventLogReader
from gateway.takes.files.writer_thread import LogFile, WriterThread

ENTRY_BYTES = 128
"""What a message takes in the queue besides its content."""


def message(number: int) -> tuple[bytes, bytes]:
    """Return a message with this ``utime``, and its channel."""
    return b"MOCAP_LAB_3D", bytes(8) + number.to_bytes(8, "big", signed=True) + bytes(100)


class NotingSink:
    """A sink that notes what is written, and how often it is synchronised."""

    def __init__(self, defect: Exception | None = None) -> None:
        self.written: list[tuple[bytes, bytes]] = []
        self.num_syncs = 0
        self._defect = defect

    def write(self, messages: Sequence[tuple[bytes, bytes]]) -> None:
        if self._defect is not None:
            raise self._defect
        self.written += messages

    def sync(self) -> None:
        self.num_syncs += 1


@pytest.fixture
def recorder() -> WriterThread:
    return WriterThread("test", 5 * (100 + ENTRY_BYTES), has_thread=False)


def test_a_queue_takes_as_much_as_its_limit_again_and_again(recorder: WriterThread) -> None:
    """If what was written did not leave the count, recording would stop after hours."""
    sink = NotingSink()
    for _ in range(3):
        accepted = [recorder.record(sink, b"C", bytes(100)) for _ in range(6)]
        assert accepted == [True] * 5 + [False]
        assert recorder.queued_bytes == 5 * (100 + ENTRY_BYTES)
        recorder.call(lambda: None)
        assert recorder.queued_bytes == 0
    assert len(sink.written) == 15
    assert not recorder.record(sink, b"C", bytes(5 * (100 + ENTRY_BYTES) - ENTRY_BYTES + 1))
    assert recorder.record(sink, b"C", bytes(5 * (100 + ENTRY_BYTES) - ENTRY_BYTES))


def test_calls_and_messages_are_made_in_the_order_of_their_arrival(recorder: WriterThread) -> None:
    """A take ends after what was published before its end, and before what comes later."""
    first, second = NotingSink(), NotingSink()
    for number in range(4):
        recorder.record((first, second)[number % 2], *message(number))
    seen = recorder.call(lambda: (len(first.written), len(second.written)))
    recorder.record(first, *message(9))
    assert seen.result() == (2, 2)
    assert recorder.close(0.0)
    assert [utime_of(content) for _, content in first.written] == [0, 2, 9]
    assert (first.num_syncs, second.num_syncs) == (1, 1)


def test_an_error_of_a_call_or_a_sink_leaves_the_others(recorder: WriterThread) -> None:
    """A defect of one take must not end the recording of another source."""
    broken, sink = NotingSink(RuntimeError("a defect")), NotingSink()
    recorder.record(broken, *message(0))
    recorder.record(sink, *message(1))
    failed = recorder.call(lambda: 1 // 0)
    assert isinstance(failed.exception(), ZeroDivisionError)
    assert sink.written == [message(1)]
    cancelled = WriterThread("test").call(lambda: None)
    assert cancelled.result(30) is None


def test_the_thread_writes_what_waits_and_ends() -> None:
    """The same with a thread, which synchronises once more at its end."""
    recorder, sink = WriterThread("test"), NotingSink()
    assert all(recorder.record(sink, *message(number)) for number in range(100))
    assert recorder.close(30)
    assert sink.written == [message(number) for number in range(100)]
    assert sink.num_syncs > 0


@pytest.mark.parametrize("written", [*range(0, 3 * 156, 31), 156, 312, 311, 313])
def test_a_full_disk_has_complete_events_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: int
) -> None:
    """The next event follows a complete one, or a reader would find damage, and no event is written twice."""
    log = LogFile(tmp_path / "walk.lcmlog")
    assert log.append([message(-1)]) == 1
    with monkeypatch.context() as patch:
        left = [written]

        def write(descriptor: int, content: memoryview) -> int:
            if not left[0]:
                raise OSError(errno.ENOSPC, "No space left on device")
            size, left[0] = min(left[0], len(content)), 0
            return original(descriptor, content[:size])

        original = os.write
        patch.setattr(os, "write", write)
        try:
            taken = log.append([message(number) for number in range(4)])
        except OSError:
            taken = 0
    assert taken == written // 156
    assert log.append([message(number) for number in range(taken, 4)]) == 4 - taken
    reader = EventLogReader(log.path)
    found = [*reader.events()]
    assert [event.utime for event in found] == [-1, 0, 1, 2, 3]
    assert [event.number for event in found] == [0, 1, 2, 3, 4]
    assert (reader.damaged_bytes, log.num_messages, log.num_bytes) == (0, 5, log.path.stat().st_size)
    log.close()


def test_a_log_knows_whether_it_still_has_its_path(tmp_path: Path) -> None:
    """What is written into a file that somebody has moved would be missing where it is expected."""
    log = LogFile(tmp_path / "walk.lcmlog")
    assert log.is_in_place()
    log.path.rename(tmp_path / "moved.lcmlog")
    assert not log.is_in_place()
    log.path.touch()
    assert not log.is_in_place()
    with pytest.raises(FileExistsError):
        LogFile(log.path)
    log.close()
