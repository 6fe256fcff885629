"""One C3D file on its way from the event loop to the disk."""

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Final

from gateway.c3d_files.spool import Spool, StoredFile, UnfinishedFile
from gateway.errors import SpoolError
from gateway.worker_thread import WorkerThread

_MIB: Final = 1024 * 1024


class IncomingFile:
    """A C3D file that arrives in pieces; ``thread`` writes them.

    The methods without underscore are called in the event loop, and so is ``on_end``, once: with the file if
    it was stored, or with the reason why it is lost.
    """

    def __init__(
        self,
        source: str,
        file_bytes: int,
        spool: Spool,
        thread: WorkerThread,
        on_end: Callable[["IncomingFile", StoredFile | SpoolError], None],
    ) -> None:
        self._source = source
        self._name = f"a C3D file of {file_bytes} bytes from {source}"
        self._spool = spool
        self._thread = thread
        self._on_end = on_end
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[bytes] = deque()  # pieces; the thread takes them out
        self._num_bytes = 0
        self._is_ended = False
        self._unfinished: UnfinishedFile | None = None  # used by the thread only, like _has_failed
        self._has_failed = False

    def add(self, piece: bytes) -> None:
        """Have a piece written. If there is no memory for it, the file is lost."""
        if self._is_ended:
            return
        if not self._spool.memory.reserve(self._source, piece):
            held_mib = self._spool.memory.held_bytes // _MIB
            self._end(
                SpoolError(
                    f"{self._name} is dropped: {held_mib} MiB of C3D files are waiting to be written; "
                    "is the disk slow, or the server faulty?"
                )
            )
            return
        self._num_bytes += len(piece)
        self._waiting.append(piece)
        self._thread.submit(self._write_next)

    def complete(self) -> None:
        """Store the file, which is complete, under its name."""
        self._thread.submit(self._keep)

    def interrupt(self, reason: str) -> None:
        """Give up the file, because no further piece of it will come."""
        self._end(SpoolError(f"{self._name} broke off after {self._num_bytes} bytes: {reason}"))

    def give_up_disk(self) -> None:
        """Give up the file, because the disk does not respond."""
        self._end(
            SpoolError(
                f"{self._name} is dropped: the disk of {self._spool.directory} does not respond; "
                "check it, and whether it is mounted"
            )
        )

    def _end(self, result: StoredFile | SpoolError) -> None:
        """Report the end of the file, once. If it is lost, free its memory and have it deleted."""
        if self._is_ended:
            return
        self._is_ended = True
        with contextlib.suppress(IndexError):  # the thread may take the last piece
            while True:
                self._spool.memory.release(self._source, self._waiting.popleft())
        self._thread.submit(self._discard)
        self._on_end(self, result)

    # In the thread.

    def _write_next(self) -> None:
        try:
            piece = self._waiting.popleft()
        except IndexError:  # the file is lost
            return
        try:
            if self._has_failed:
                return
            if self._unfinished is None:
                self._unfinished = self._spool.begin()
            self._unfinished.write(piece)
        except OSError as error:
            self._fail(error)
        finally:
            self._spool.memory.release(self._source, piece)

    def _keep(self) -> None:
        unfinished = self._unfinished
        if unfinished is None or self._is_ended:
            return
        try:
            stored = self._spool.keep(self._source, unfinished)
        except OSError as error:
            self._fail(error)
        else:
            self._unfinished = None
            self._report(stored)

    def _discard(self) -> None:
        """Delete the file, unless it was stored."""
        if self._unfinished is not None:
            self._unfinished.discard()
            self._unfinished = None

    def _fail(self, error: OSError) -> None:
        self._has_failed = True
        self._discard()
        self._report(
            SpoolError(
                f"{self._name} cannot be stored in {self._spool.directory}: {error.strerror}; "
                "check spool.directory and the space on it"
            )
        )

    def _report(self, result: StoredFile | SpoolError) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: the gateway has stopped
            self._loop.call_soon_threadsafe(partial(self._end, result))
