"""Writing messages to event logs, by a thread from a bounded queue: a slow disk never delays the stream."""

import logging
import os
import struct
import threading
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from itertools import accumulate
from pathlib import Path
from typing import Final, Protocol, TypeVar

from gateway.runtime.failures import DefectLog
from gateway.runtime.workers import make_call, thread_starts
from gateway.takes.files.event_log import SYNC

MAX_QUEUED_BYTES: Final = 64 * 1024 * 1024
"""How much may wait for the disk; at 1.3 MB/s, the disk may stand still for 50 s."""

WRITE_PERIOD_S: Final = 0.1
SYNC_PERIOD_S: Final = 0.5
"""How often the thread writes, and how often it has the system store everything on the disk."""

_ENTRY_BYTES: Final = 128
"""What a message in the queue takes besides its content."""

_HEADER: Final = struct.Struct(">4sq8sii")
"""The header of an event (event_log.py), with the time as the eight bytes that the message has, too."""

_pack_header: Final = _HEADER.pack
_UTIME_START: Final = 8
_UTIME_STOP: Final = 16
"""Where a message of the gateway has its ``utime``, after the fingerprint."""

_Result = TypeVar("_Result")

logger = logging.getLogger(__name__)


class LogFile:
    """A new event log. Its methods block: call them in a thread.

    Raises OSError if the file exists or cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.num_messages = 0
        self.num_bytes = 0
        self._newest_bytes = 0  # the size of the newest event
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)

    def append(self, messages: Sequence[tuple[bytes, bytes]]) -> int:
        """Append messages of the gateway, each with its channel. The time of an event is their ``utime``.

        Returns how many the disk has taken, at least one. Raises OSError if it takes none.
        """
        pieces: list[bytes] = []
        number = self.num_messages
        for channel, message in messages:
            # Three pieces, so that each message is copied only once (benchmarks/own_cost.py).
            pieces.append(
                _pack_header(SYNC, number, message[_UTIME_START:_UTIME_STOP], len(channel), len(message))
            )
            pieces.append(channel)
            pieces.append(message)
            number += 1
        events = memoryview(b"".join(pieces))
        num_bytes = 0
        try:
            while num_bytes < len(events):
                num_bytes += os.write(self._descriptor, events[num_bytes:])
        except OSError:
            sizes = [_HEADER.size + len(channel) + len(message) for channel, message in messages]
            ends = [0, *accumulate(sizes)]
            num_messages = bisect_right(ends, num_bytes) - 1  # that are complete
            num_bytes = ends[num_messages]
            # The next event must follow a complete one.
            os.ftruncate(self._descriptor, self.num_bytes + num_bytes)
            os.lseek(self._descriptor, self.num_bytes + num_bytes, os.SEEK_SET)
            if not num_messages:
                raise
        else:
            num_messages = len(messages)
        self.num_messages += num_messages
        self.num_bytes += num_bytes
        channel, message = messages[num_messages - 1]
        self._newest_bytes = _HEADER.size + len(channel) + len(message)
        return num_messages

    def remove_newest(self) -> None:
        """Remove the newest event, so that a smaller one finds room on a full disk. Raises OSError."""
        self.num_messages -= 1
        self.num_bytes -= self._newest_bytes
        self._newest_bytes = 0
        os.ftruncate(self._descriptor, self.num_bytes)
        os.lseek(self._descriptor, self.num_bytes, os.SEEK_SET)

    def sync(self) -> None:
        """Store on the disk what was appended. Raises OSError."""
        os.fdatasync(self._descriptor)

    def is_in_place(self) -> bool:
        """Return whether the file still has its path: it or its folder may have been moved or deleted."""
        try:
            there = self.path.stat()
        except OSError:
            return False
        return os.path.samestat(there, os.fstat(self._descriptor))

    def close(self) -> None:
        """Store everything and close the file. Raises OSError."""
        try:
            os.fsync(self._descriptor)
        finally:
            os.close(self._descriptor)


class Sink(Protocol):
    """What a WriterThread writes to: it handles the errors of the disk, and raises nothing."""

    def write(self, messages: Sequence[tuple[bytes, bytes]]) -> None:
        """Write messages, each with its channel."""

    def sync(self) -> None:
        """Store on the disk what was written."""


class WriterThread:
    """A thread that writes messages to sinks, in the order in which they were recorded.

    The program does not wait for the thread when it ends; ``close`` does. Without a thread, ``call`` and
    ``close`` write: then a test knows when something is written.
    """

    def __init__(
        self, name: str, max_queued_bytes: int = MAX_QUEUED_BYTES, *, has_thread: bool = True
    ) -> None:
        self._max_queued_bytes = max_queued_bytes
        self._queue: deque[tuple[Sink, bytes, bytes] | Callable[[], None]] = deque()
        # Each is changed by one thread only; the difference is what waits.
        self._offered_bytes = 0
        self._written_bytes = 0
        self._wake = threading.Event()
        self._is_closed = False
        self._unsynced: dict[Sink, None] = {}
        self._defects = DefectLog(logger, name)
        self._writer: threading.Thread | None = None
        if has_thread:
            self._writer = threading.Thread(target=self._run, name=name, daemon=True)
            thread_starts.start(self._writer)

    @property
    def queued_bytes(self) -> int:
        """How many bytes wait for the disk."""
        return self._offered_bytes - self._written_bytes

    def record(self, sink: Sink, channel: bytes, message: bytes) -> bool:
        """Queue a message; return False if the queue is full. Call it in one thread only."""
        num_bytes = len(message) + _ENTRY_BYTES
        if self._offered_bytes + num_bytes - self._written_bytes > self._max_queued_bytes:
            return False
        self._offered_bytes += num_bytes
        self._queue.append((sink, channel, message))
        return True

    def call(self, function: Callable[[], _Result]) -> Future[_Result]:
        """Call ``function`` in the thread, after everything recorded so far was written.

        The future can be cancelled before; then nothing is called.
        """
        done: Future[_Result] = Future()
        self._queue.append(lambda: make_call(done, function))
        if self._writer is None:
            self._write_queue()
        else:
            self._wake.set()
        return done

    def close(self, timeout_s: float) -> bool:
        """Write what waits, and end the thread. Return False if the disk needs longer than ``timeout_s``."""
        self._is_closed = True
        if self._writer is None:
            self._write_queue()
            self._sync()
            return True
        self._wake.set()
        self._writer.join(timeout_s)
        return not self._writer.is_alive()

    def _run(self) -> None:
        synced_s = time.monotonic()
        while not (self._is_closed and not self._queue):
            self._wake.wait(WRITE_PERIOD_S)
            self._wake.clear()
            self._write_queue()
            if time.monotonic() - synced_s >= SYNC_PERIOD_S or self._is_closed:
                self._sync()
                synced_s = time.monotonic()

    def _sync(self) -> None:
        for sink in self._unsynced:
            sink.sync()
        self._unsynced.clear()

    def _write_queue(self) -> None:
        # This is the inner loop of recording; benchmarks/own_cost.py measures it.
        batches: dict[Sink, list[tuple[bytes, bytes]]] = {}
        newest_sink: Sink | None = None
        batch: list[tuple[bytes, bytes]] = []
        num_bytes = 0
        for _ in range(len(self._queue)):
            entry = self._queue.popleft()
            if isinstance(entry, tuple):
                sink, channel, message = entry
                if sink is not newest_sink:
                    newest_sink = sink
                    batch = batches.setdefault(sink, [])
                batch.append((channel, message))
                num_bytes += len(message) + _ENTRY_BYTES
            else:
                self._write(batches, num_bytes)
                batches, newest_sink, num_bytes = {}, None, 0
                entry()
        self._write(batches, num_bytes)

    def _write(self, batches: dict[Sink, list[tuple[bytes, bytes]]], num_bytes: int) -> None:
        for sink, messages in batches.items():
            try:
                sink.write(messages)
            except Exception as defect:  # noqa: BLE001 - the other sinks continue
                self._defects.log(defect)
            self._unsynced[sink] = None
        self._written_bytes += num_bytes
