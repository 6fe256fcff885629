"""The C3D files of one source: taken from its streams in pieces, checked, and passed on to the disk."""

import asyncio
from collections.abc import Callable
from typing import Final

from gateway.c3d_files.format_check import HEAD_BYTES, problem_of_c3d
from gateway.c3d_files.incoming import IncomingFile
from gateway.c3d_files.spool import Spool, StoredFile
from gateway.errors import SpoolError
from gateway.rtc3d.packets import FilePiece
from gateway.token_bucket import TokenBucket
from gateway.worker_thread import WorkerThread

_MAX_UNSTORED_FILES: Final = 4
"""How many files of a source may arrive, or wait for the disk, at the same time."""

_MAX_FILES_AT_ONCE: Final = 20
_FILE_PERIOD_S: Final = 3.0
"""A source may store 20 files one after the other, and then one in 3 s: more is no recording, and would fill
the log."""

_MAX_DISK_S: Final = 30.0
"""How long the disk may take for one piece, or to complete a file. After that, it does not respond."""

_FINISH_S: Final = 0.5
"""How long the end of the source waits for the disk."""


class SourceFiles:
    """The C3D files of one source.

    ``spool`` returns the folder of new files; a reload may change it. ``on_stored`` is called in the event
    loop with every file that was stored.
    """

    def __init__(
        self, source: str, spool: Callable[[], Spool], on_stored: Callable[[StoredFile], None]
    ) -> None:
        self._source = source
        self._spool = spool
        self._on_stored = on_stored
        self._thread = WorkerThread(f"c3d-{source}")
        self._unstored: dict[IncomingFile, Callable[[SpoolError], None]] = {}
        self._is_disk_silent = False
        self._allowed = TokenBucket(1 / _FILE_PERIOD_S, _MAX_FILES_AT_ONCE)

    def receiver(self, on_lost: Callable[[SpoolError], None]) -> "FileReceiver":
        """Return what takes the files of one stream; ``on_lost`` is called with each one that is lost."""
        return FileReceiver(self, on_lost)

    def begin(self, head: bytes, file_bytes: int, on_lost: Callable[[SpoolError], None]) -> IncomingFile:
        """Return a new file that begins with ``head``. Raises SpoolError if it is refused."""
        name = f"a C3D file of {file_bytes} bytes"
        problem = problem_of_c3d(head, file_bytes)
        if problem:
            raise SpoolError(f"{name} is refused: {problem}")
        spool = self._spool()
        if file_bytes > spool.max_bytes:
            raise SpoolError(
                f"{name} from {self._source} is not stored: spool.max_bytes is {spool.max_bytes}"
            )
        if self._is_disk_silent:
            raise SpoolError(f"{name} is dropped: the disk of {spool.directory} does not respond")
        if len(self._unstored) >= _MAX_UNSTORED_FILES:
            raise SpoolError(
                f"{name} is dropped: {len(self._unstored)} earlier files are still being written; "
                "is the disk slow, or the server faulty?"
            )
        if self._allowed.left < 1:
            raise SpoolError(
                f"{name} is dropped: {self._source} sends more than one file in {_FILE_PERIOD_S:g} s; "
                "is the server faulty?"
            )
        self._allowed.take()
        file = IncomingFile(self._source, file_bytes, spool, self._thread, self._end)
        self._unstored[file] = on_lost
        return file

    def check(self) -> None:
        """Give up the files that wait for a disk that does not respond. Call it once a second."""
        if self._thread.call_age_s > _MAX_DISK_S:
            self._is_disk_silent = True
            for file in [*self._unstored]:
                file.give_up_disk()
        else:
            self._is_disk_silent = False

    async def finish(self) -> None:
        """Wait until the files that have arrived are stored, but not long: the disk may not respond."""
        if not self._unstored:
            return
        written = asyncio.wrap_future(self._thread.submit(lambda: None))
        await asyncio.wait([written], timeout=_FINISH_S)

    def _end(self, file: IncomingFile, result: StoredFile | SpoolError) -> None:
        on_lost = self._unstored.pop(file)
        if isinstance(result, StoredFile):
            self._on_stored(result)
        else:
            on_lost(result)


class FileReceiver:
    """Takes the C3D files of one stream in pieces. A file that is refused is skipped to its end."""

    def __init__(self, files: SourceFiles, on_lost: Callable[[SpoolError], None]) -> None:
        self._files = files
        self._on_lost = on_lost
        self._head = b""  # until there are HEAD_BYTES of a file
        self._file: IncomingFile | None = None  # the one that is arriving
        self._is_skipping = False

    def receive(self, piece: FilePiece) -> None:
        """Take the next piece. The first one decides whether the file is refused."""
        content = piece.body
        if piece.is_first:
            self._file, self._head, self._is_skipping = None, b"", False
        if self._is_skipping:
            return
        if self._file is None:
            content = self._head + content
            if len(content) < HEAD_BYTES and not piece.is_last:
                self._head = content
                return
            try:
                self._file = self._files.begin(content, piece.file_bytes, self._on_lost)
            except SpoolError as error:
                self._is_skipping = True
                self._on_lost(error)
                return
        self._file.add(content)
        if piece.is_last:
            self._file.complete()
            self._file = None

    def interrupt(self, reason: str) -> None:
        """Give up the file that is arriving, because the connection has ended."""
        if self._file is not None:
            self._file.interrupt(reason)
            self._file = None
        self._is_skipping = True
