"""The C3D files of one source: taken from its streams in pieces, checked, and passed on to the disk.

A C3D file has blocks of 512 bytes. The first one is the header: byte 0 is the number, from 1, of the block
where the parameters begin, byte 1 is the key 0x50.
"""

import asyncio
import contextlib
import math
import struct
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Final

from gateway.errors import FileLoss, SpoolError
from gateway.rtc3d.packets import FilePiece
from gateway.runtime.safe_text import safe_text
from gateway.runtime.token_bucket import TokenBucket
from gateway.runtime.workers import WorkerThread
from gateway.session.c3d_files.spool import Spool, StoredFile, UnfinishedFile

HEAD_BYTES: Final = 2
PARAMETERS_END_BYTES: Final = 1024 * 1024
"""The parameters are within these first bytes: they begin in one of 255 blocks and have at most 255."""

_BLOCK_BYTES: Final = 512
_KEY: Final = 0x50
_FIRST_PARAMETER_BLOCK: Final = 2
_DATA_BLOCK_OFFSET: Final = 16
"""Where the header has the number of the block where the frames begin."""
DEC, BIG_ENDIAN = 85, 86  # of the types of processors; the usual one is 84, little-endian
_FORMATS: Final = {1: "B", 2: "H", 4: "f"}


def problem_of_c3d(head: bytes, file_bytes: int) -> str:
    """Return why a file of ``file_bytes`` is no C3D file; "" if ``head``, its first HEAD_BYTES, is one's."""
    if file_bytes == 0:
        return "it is empty"
    if file_bytes < _BLOCK_BYTES:
        return f"it has {file_bytes} bytes, and the header of a C3D file has {_BLOCK_BYTES}"
    if head[1] != _KEY:
        return "its first bytes are not those of a C3D file"
    if not _FIRST_PARAMETER_BLOCK <= head[0] <= 1 + file_bytes // _BLOCK_BYTES:
        return "its parameters would begin outside of it"
    return ""


def problem_of_sizes(head: bytes, file_bytes: int) -> str:
    """Return which size stated in a C3D file cannot be true; "" if none.

    ``head`` is its first PARAMETERS_END_BYTES. Check it before a reader allocates what it states.
    """
    start = parameters_start(head)
    if len(head) < start + 4:
        return "it ends before its parameters"
    processor = head[start + 3]
    order = ">" if processor == BIG_ENDIAN else "<"
    (data_block,) = struct.unpack_from(f"{order}H", head, _DATA_BLOCK_OFFSET)
    data_start = max(data_block - 1, 0) * _BLOCK_BYTES
    stated_end = max(data_start, start + head[start + 2] * _BLOCK_BYTES)
    end = stated_end if start < stated_end <= file_bytes else file_bytes
    numbers: dict[str, float] = {}
    for name, element_bytes, offset, num_bytes in parameter_places(head[:end], start + 4, order):
        if offset + num_bytes > end:
            return f"its parameter {safe_text(name)} would have {num_bytes} bytes, more than it has"
        if num_bytes == element_bytes in _FORMATS and offset + 4 <= len(head):
            (numbers[name],) = struct.unpack_from(order + _FORMATS[element_bytes], head, offset)
    rates_hz = numbers.get("ANALOG:RATE", 0.0), numbers.get("POINT:RATE", 0.0)
    ratio = rates_hz[0] / rates_hz[1] if processor != DEC and rates_hz[1] > 0 else 1.0
    samples = ratio if math.isfinite(ratio) else 1.0
    values = 4 * numbers.get("POINT:USED", 0) + numbers.get("ANALOG:USED", 0) * samples
    room = max(file_bytes - data_start, 0)
    if 2 * values > room:
        return f"each of its frames would have at least {2 * values:.0f} bytes, and it has {room} for all"
    return ""


def parameters_start(head: bytes) -> int:
    """Return where the parameters of a C3D file begin, which ``problem_of_c3d`` has found to be one."""
    return (head[0] - 1) * _BLOCK_BYTES


def parameter_places(head: bytes, position: int, order: str) -> list[tuple[str, int, int, int]]:
    """Return the name of each parameter, the size of an element, and where its values are and their size.

    The name is GROUP:NAME. What cannot be read ends the list.
    """
    groups: dict[int, str] = {}
    found = []
    while position + 2 <= len(head):
        length, group = struct.unpack_from("bb", head, position)
        name = head[position + 2 : position + 2 + abs(length)].decode("latin-1").strip().upper()
        at = position + 2 + abs(length)
        if length == 0 or group == 0 or at + 4 > len(head):
            break
        (offset,) = struct.unpack_from(f"{order}H", head, at)
        if group < 0:
            groups[-group] = name
        else:
            element_bytes = abs(struct.unpack_from("b", head, at + 2)[0])
            sizes = head[at + 4 : at + 4 + head[at + 3]]
            num_bytes = element_bytes * math.prod(sizes)
            found.append((group, name, element_bytes, at + 4 + len(sizes), num_bytes))
        if offset == 0:
            break
        position = at + offset
    # A group may be defined after its parameters.
    return [(f"{groups.get(group, group)}:{name}", *rest) for group, name, *rest in found]


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
        self.directory = spool.directory
        """Where the file will be."""
        self.name = f"a C3D file of {file_bytes} bytes from {source}"
        """What the file is called in messages."""
        self._source = source
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
            self.end(
                SpoolError(
                    f"{self.name} is dropped: {held_mib} MiB of C3D files are waiting to be written; "
                    "is the disk slow, or the server faulty?",
                    cause=FileLoss.NO_MEMORY,
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
        self.end(
            SpoolError(
                f"{self.name} broke off after {self._num_bytes} bytes: {reason}", cause=FileLoss.BROKEN_OFF
            )
        )

    def end(self, result: StoredFile | SpoolError) -> None:
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
            if not self._has_failed:
                self._unfinished = self._unfinished or self._spool.begin()
                self._unfinished.write(piece)
        except OSError as error:
            self._fail(error)
        finally:
            self._spool.memory.release(self._source, piece)

    def _keep(self) -> None:
        if self._unfinished is None or self._is_ended:
            return
        try:
            stored = self._spool.keep(self._source, self._unfinished)
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
                f"{self.name} cannot be stored in {self.directory}: {error.strerror}; "
                "check spool.directory and the space on it",
                cause=FileLoss.NOT_WRITTEN,
            )
        )

    def _report(self, result: StoredFile | SpoolError) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: the gateway has stopped
            self._loop.call_soon_threadsafe(partial(self.end, result))


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

    def begin(self, head: bytes, file_bytes: int, on_lost: Callable[[SpoolError], None]) -> IncomingFile:
        """Return a new file that begins with ``head``. Raises SpoolError if it is refused."""
        name = f"a C3D file of {file_bytes} bytes"
        problem = problem_of_c3d(head, file_bytes)
        if problem:
            raise SpoolError(f"{name} is refused: {problem}", cause=FileLoss.NO_C3D_FILE)
        spool = self._spool()
        if file_bytes > spool.max_bytes:
            raise SpoolError(
                f"{name} from {self._source} is not stored: spool.max_bytes is {spool.max_bytes}",
                cause=FileLoss.TOO_LARGE,
            )
        if self._is_disk_silent:
            raise SpoolError(
                f"{name} is dropped: the disk of {spool.directory} does not respond",
                cause=FileLoss.DISK_SILENT,
            )
        if len(self._unstored) >= _MAX_UNSTORED_FILES:
            raise SpoolError(
                f"{name} is dropped: {len(self._unstored)} earlier files are still being written; "
                "is the disk slow, or the server faulty?",
                cause=FileLoss.DISK_BUSY,
            )
        if self._allowed.left < 1:
            raise SpoolError(
                f"{name} is dropped: {self._source} sends more than one file in {_FILE_PERIOD_S:g} s; "
                "is the server faulty?",
                cause=FileLoss.TOO_OFTEN,
            )
        self._allowed.take()
        file = IncomingFile(self._source, file_bytes, spool, self._thread, self._end)
        self._unstored[file] = on_lost
        return file

    def check(self) -> None:
        """Give up the files that wait for a disk that does not respond. Call it once a second."""
        self._is_disk_silent = self._thread.call_age_s > _MAX_DISK_S
        if self._is_disk_silent:
            for file in [*self._unstored]:
                file.end(
                    SpoolError(
                        f"{file.name} is dropped: the disk of {file.directory} does not respond; "
                        "check it, and whether it is mounted",
                        cause=FileLoss.DISK_SILENT,
                    )
                )

    async def finish(self) -> None:
        """Wait until the files that have arrived are stored, but not long: the disk may not respond."""
        if self._unstored:
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
