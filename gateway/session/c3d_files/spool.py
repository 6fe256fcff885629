"""The folder of C3D files that servers have sent, limited in number and size for each source."""

import contextlib
import fcntl
import os
import re
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final, NamedTuple

from gateway.runtime.workers import WorkerThread

_PIECE_BYTES: Final = 200
"""What a piece takes besides its content. A server may send a file byte by byte."""


class QueueMemory:
    """Counts the bytes of all sources that wait to be written.

    A source may hold as many bytes as are free for all, so at most half of the total: it cannot take the
    memory from the others. Any thread may call the methods.
    """

    def __init__(self, max_bytes: int) -> None:
        self._free = max_bytes
        self._held: Counter[str] = Counter()
        self._lock = threading.Lock()

    def reserve(self, source: str, piece: bytes) -> bool:
        """Reserve memory for a piece; return False if there is not enough."""
        num_bytes = len(piece) + _PIECE_BYTES
        with self._lock:
            if self._held[source] + num_bytes > self._free:
                return False
            self._held[source] += num_bytes
            self._free -= num_bytes
        return True

    def release(self, source: str, piece: bytes) -> None:
        """Return the memory of a piece that no longer waits."""
        num_bytes = len(piece) + _PIECE_BYTES
        with self._lock:
            self._held[source] -= num_bytes
            self._free += num_bytes

    @property
    def held_bytes(self) -> int:
        """How many bytes wait now."""
        with self._lock:
            return self._held.total()


# Files with other names do not belong to the gateway: it leaves them alone. The time has a fixed length, so
# that a file of "lab-2" is not taken for one of "lab".
_NAME: Final = re.compile(r"(?P<source>.+)-(?P<time>\d{8}T\d{6}\.\d{6}Z)\.c3d")
_TIME: Final = "%Y%m%dT%H%M%S.%fZ"
_UNFINISHED: Final = ".c3d.part"
_MAX_QUEUED_BYTES: Final = 512 * 1024 * 1024
"""The memory for files that wait for the disk. One source may take half: the largest file by default."""


class StoredFile(NamedTuple):
    """A file that was stored, the older ones that were deleted for it, and what could not be done, or ""."""

    path: Path
    num_bytes: int
    deleted: tuple[Path, ...] = ()
    problem: str = ""


class _File(NamedTuple):
    time: datetime
    path: Path
    num_bytes: int


class UnfinishedFile:
    """A file with a temporary name. The lock on it shows that a gateway is writing it."""

    def __init__(self, directory: Path) -> None:
        self._descriptor, name = tempfile.mkstemp(suffix=_UNFINISHED, dir=directory)
        self._path = Path(name)
        self._num_bytes = 0
        # Some network drives have no locks. There, nobody deletes the file if this gateway is killed.
        with contextlib.suppress(OSError):
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def write(self, piece: bytes) -> None:
        """Append a piece. Raises OSError."""
        rest = memoryview(piece)
        while rest:
            rest = rest[os.write(self._descriptor, rest) :]
        self._num_bytes += len(piece)

    def finish(self, path: Path) -> int:
        """Write everything to the disk, give the file its name, and return its size. Raises OSError."""
        os.fsync(self._descriptor)
        self._path.replace(path)
        self._close()
        return self._num_bytes

    def discard(self) -> None:
        """Delete the file."""
        with contextlib.suppress(OSError):
            self._path.unlink()
        self._close()

    def _close(self) -> None:
        with contextlib.suppress(OSError):  # fsync has reported every error that matters
            os.close(self._descriptor)


class Spool:
    """Stores files as DIRECTORY/SOURCE-YYYYMMDDThhmmss.ffffffZ.c3d, and deletes the oldest ones.

    ``max_files`` and ``max_bytes`` apply to each source. Its methods block while they read and write files:
    call them in a thread.
    """

    def __init__(
        self, directory: Path, max_files: int, max_bytes: int, max_queued_bytes: int = _MAX_QUEUED_BYTES
    ) -> None:
        self.directory = directory
        self.max_bytes = max_bytes
        self._max_files = max_files
        self._creating = threading.Lock()
        self.memory: QueueMemory = QueueMemory(max_queued_bytes)
        """The memory for the pieces of files that wait to be written."""
        self.reader: WorkerThread = WorkerThread("c3d-read")
        """The thread that looks for files for peers."""

    def begin(self) -> UnfinishedFile:
        """Create a file with a temporary name. Raises OSError."""
        self.directory.mkdir(parents=True, exist_ok=True)
        self.delete_abandoned()
        with self._creating:
            return UnfinishedFile(self.directory)

    def keep(self, source: str, unfinished: UnfinishedFile) -> StoredFile:
        """Give a complete file its name, and delete the oldest files of its source beyond the limits.

        Raises OSError if the file is not stored. What else goes wrong is the ``problem`` of the result.
        """
        problem = ""
        earlier: list[_File] = []
        try:
            earlier = sorted(self._files(source), reverse=True)
        except OSError as error:
            problem = f"{self.directory} cannot be listed: {error.strerror}"
        time = datetime.now(UTC)
        if earlier and earlier[0].time >= time:  # the clock was set back
            time = earlier[0].time + timedelta(microseconds=1)
        path = self.directory / f"{source}-{time:{_TIME}}.c3d"
        num_bytes = kept_bytes = unfinished.finish(path)
        deleted = []
        for number, file in enumerate(earlier, start=2):
            kept_bytes += file.num_bytes
            if number <= self._max_files and kept_bytes <= self.max_bytes:
                continue
            try:
                file.path.unlink(missing_ok=True)
                deleted.append(file.path)
            except OSError as error:
                problem = f"{file.path} cannot be deleted: {error.strerror}"
        return StoredFile(path, num_bytes, tuple(deleted), problem)

    def newest(self, source: str) -> Path | None:
        """Return the newest file of ``source``, None if there is none. Raises OSError."""
        own = [*self._files(source)] if self.directory.exists() else []
        return max(own).path if own else None

    def delete_abandoned(self) -> None:
        """Delete unfinished files that nobody writes, because a gateway was killed."""
        with self._creating, contextlib.suppress(OSError):
            for entry in [*os.scandir(self.directory)]:
                if not (entry.name.endswith(_UNFINISHED) and entry.is_file(follow_symlinks=False)):
                    continue
                with contextlib.suppress(OSError):  # the lock: somebody writes the file
                    descriptor = os.open(entry.path, os.O_RDONLY | os.O_NONBLOCK)
                    try:
                        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                        Path(entry.path).unlink()
                    finally:
                        os.close(descriptor)

    def _files(self, source: str) -> Iterator[_File]:
        for entry in [*os.scandir(self.directory)]:
            name = _NAME.fullmatch(entry.name)
            if name is None or name["source"] != source or not entry.is_file(follow_symlinks=False):
                continue
            # The file may be deleted by hand, or its name may have a time that does not exist.
            with contextlib.suppress(FileNotFoundError, ValueError):
                time = datetime.strptime(name["time"], _TIME).replace(tzinfo=UTC)
                yield _File(time, Path(entry.path), entry.stat(follow_symlinks=False).st_size)
