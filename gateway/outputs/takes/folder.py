"""The folder of takes: what is in it, and reading it. Everything here blocks: call it in a thread."""

import contextlib
import errno
import fcntl
import logging
import os
import re
import shutil
import stat
import threading
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import rtc3d

from gateway.errors import ProtocolError, QueryError, TakeError
from gateway.messages.decode import decode
from gateway.messages.take_names import by_number, check_name, default_name, numbered
from gateway.takes.files.description import NO_DETAILS, TakeDetails, decoded_details, has_end
from gateway.takes.files.event_log import EventLogReader
from gateway.takes.files.new_file import NewFiles
from gateway.takes.files.reader import SUFFIX

ROLLING: Final = ".rolling"
"""The folder of the rolling segments, in that of the takes."""

C3D_SUFFIX: Final = ".c3d"

_FURTHER_C3D: Final = re.compile(r" \(\d+\)$|-\d+$")
"""What follows the name of the take in that of a further C3D file. Earlier gateways wrote "-2"."""

_REMEDIES: Final = {
    errno.ENOSPC: "make room on it, or lower takes.max_bytes",
    errno.EDQUOT: "make room on it, or lower takes.max_bytes",
    errno.EACCES: "let the gateway write there",
    errno.EPERM: "let the gateway write there",
    errno.EROFS: "mount it so that the gateway can write",
    errno.ENOENT: "is the disk mounted? If so, create the folder, or start the gateway again",
    errno.ENOTDIR: "choose a folder as takes.directory",
}

_LOCK: Final = ".rtc3d-gateway.lock"
_TAIL_BYTES: Final = 256 * 1024
_END_BYTES: Final = 4096
_COPIED_BYTES: Final = 1024 * 1024
_MAX_REMEMBERED: Final = 10_000

logger = logging.getLogger(__name__)

FileId = tuple[int, int]
"""Device and inode: links to the same file count once."""


MAX_PIECE_BYTES: Final = 1024 * 1024
"""The most bytes of a take that one call reads."""


class StoredTake(NamedTuple):
    """A take in the folder.

    ``begin_utime`` is the time of its first message in µs since the Unix epoch, ``seconds`` how long it
    lasts, ``num_lost`` how many messages found no room on the disk. A take is running until everything of it
    is in its files. It is cut off if one of its files was not ended in order, because the gateway was killed
    or the disk failed.
    """

    name: str
    num_bytes: int
    begin_utime: int
    seconds: float
    is_running: bool = False
    num_lost: int = 0
    is_cut_off: bool = False
    details: TakeDetails = NO_DETAILS


class TakePiece(NamedTuple):
    """A part of the bytes of a take; the files of a saved take are read as one."""

    name: str
    num_bytes: int
    offset: int
    content: bytes


@dataclass
class TakeEntry:
    """A take in the folder: a log or a folder of logs, and the C3D files of the same name.

    ``path`` is without the extension.
    """

    path: Path
    logs: list[tuple[Path, os.stat_result]] = field(default_factory=list)
    c3d_files: list[tuple[Path, os.stat_result]] = field(default_factory=list)

    @property
    def source(self) -> str:
        """The name of the source."""
        return self.path.parent.name

    @property
    def end_s(self) -> float:
        """When it was written last, in s since the Unix epoch."""
        return max(status.st_mtime for _, status in self.logs)

    @property
    def num_bytes(self) -> int:
        """The size of the logs."""
        return sum(status.st_size for _, status in self.logs)

    @property
    def sizes(self) -> dict[FileId, int]:
        """The size of each file."""
        files = (*self.logs, *self.c3d_files)
        return {(status.st_dev, status.st_ino): status.st_size for _, status in files}


class TakesFolder:
    """The folder of the takes of all sources: DIRECTORY/SOURCE/NAME.lcmlog, or a folder NAME of saved logs.

    Other files do not belong to the gateway: it leaves them alone.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._was_open = False
        self._lock: int | None = None
        self._is_closed = False
        self.needs_recovery = False
        """Whether this is a new folder or another disk since ``recover`` was called last."""
        self._opening = threading.Lock()
        self._takes: dict[tuple[Path, int, int], StoredTake] = {}  # by path, size and time

    # The folder itself.

    def open(self) -> str:
        """Check whether takes can be written here; return what is wrong, or "". May be called again."""
        try:
            # If a folder is missing later, its disk is not mounted any more.
            if not self._was_open:
                with contextlib.suppress(FileExistsError):  # a file is there instead, as check_directory says
                    self.directory.mkdir(parents=True, exist_ok=True)
            check_directory(self.directory)
            self._was_open = True
            with self._opening:
                # A check that is late must not lock the folder again: nobody would unlock it.
                return f"{self.directory} is closed" if self._is_closed else self._take_lock()
        except OSError as error:
            return disk_problem(self.directory, error)

    def _take_lock(self) -> str:
        """Lock the folder for this gateway: two would delete each other's segments."""
        path = self.directory / _LOCK
        if self._lock is not None:
            with contextlib.suppress(OSError):
                if os.path.samestat(os.fstat(self._lock), path.stat()):
                    return ""
            os.close(self._lock)
            self._lock = None
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return f"another gateway records in {self.directory}; give each its own takes.directory"
        except OSError:
            logger.debug("%s has no locks", self.directory)  # as some network drives
        self._lock = descriptor
        self.needs_recovery = True
        return ""

    def close(self) -> None:
        """Let another gateway use the folder; this object cannot be used any more."""
        with self._opening:
            self._is_closed = True
            lock, self._lock = self._lock, None
            if lock is not None:
                with contextlib.suppress(OSError):
                    fcntl.flock(lock, fcntl.LOCK_UN)  # a process that was just forked may still have it open
                os.close(lock)

    def recover(self, own: Collection[Path] = ()) -> None:
        """Keep the segments that a killed gateway has left behind as a take, if the folder can be used.

        ``own`` are those of this gateway, which are left alone.
        """
        if not self.open():
            self.needs_recovery = False
            try:
                self._recover(own)
            except OSError as error:
                logger.warning("takes: %s", disk_problem(self.directory / ROLLING, error))

    def _recover(self, own: Collection[Path]) -> None:
        rolling = self.directory / ROLLING
        for folder in sorted(rolling.iterdir()) if rolling.is_dir() else ():
            segments = [path for path, _ in _files(folder) if path.suffix == SUFFIX and path not in own]
            if segments:
                stem = self.directory / folder.name / default_name(folder.name)
                take = free_stem(stem, has_free_name=True)
                take.mkdir()
                for number, segment in enumerate(segments, start=1):
                    segment.replace(take / f"{take.name}-{number:03}{SUFFIX}")
                logger.warning(
                    "takes: the last seconds of %s before the gateway was killed are kept as %s",
                    *(folder.name, take),
                )
            with contextlib.suppress(OSError):
                folder.rmdir()

    # Takes.

    def entries(self, source: str | None = None) -> list[TakeEntry]:
        """Return all takes, or those of one source. Raises OSError."""
        entries: list[TakeEntry] = []
        if source is not None:
            return _source_entries(self.directory / source)
        for folder in [*os.scandir(self.directory)]:
            if folder.is_dir(follow_symlinks=False) and not folder.name.startswith("."):
                entries += _source_entries(Path(folder.path))
        return entries

    def takes(self, source: str, running: Collection[str]) -> list[StoredTake]:
        """Return the takes of a source, the newest first; those named in ``running`` are. Raises OSError."""
        entries = sorted(self.entries(source), key=lambda entry: entry.end_s, reverse=True)
        return [self._stored(entry, entry.path.name in running) for entry in entries]

    def take_at(self, path: Path, *, is_running: bool = False) -> StoredTake:
        """Return the take with this path, without extension. Raises OSError, and QueryError if it is gone."""
        for entry in _source_entries(path.parent, path.name):
            return self._stored(entry, is_running)
        raise QueryError(f"there is no take {path} any more; somebody has removed it")

    def _stored(self, entry: TakeEntry, is_running: bool) -> StoredTake:
        newest_ns = max(status.st_mtime_ns for _, status in entry.logs)
        identity = (entry.path, entry.num_bytes, newest_ns)
        if identity not in self._takes:
            if len(self._takes) > _MAX_REMEMBERED:
                self._takes.clear()
            self._takes[identity] = _read_take(entry)
        take = self._takes[identity]
        return take._replace(is_running=True, is_cut_off=False) if is_running else take

    def read(self, source: str, name: str, offset: int) -> TakePiece:
        """Return a part of a take; its files are read as one. Raises OSError, QueryError."""
        check_name(name)
        entries = _source_entries(self.directory / source, name)
        if not entries:
            raise QueryError(f"source {source!r} has no take {name!r}; take list shows which there are")
        content, start = b"", offset
        for path, status in entries[0].logs:
            if start >= status.st_size:
                start -= status.st_size
            elif len(content) < MAX_PIECE_BYTES:
                with path.open("rb") as file:
                    file.seek(start)
                    content += file.read(min(MAX_PIECE_BYTES - len(content), status.st_size - start))
                start = 0
        return TakePiece(name, entries[0].num_bytes, offset, content)

    def rolling_sizes(self) -> dict[FileId, int]:
        """Return the size of each file of the rolling segments. Raises OSError."""
        sizes: dict[FileId, int] = {}
        with contextlib.suppress(FileNotFoundError):
            for folder in [*os.scandir(self.directory / ROLLING)]:
                for _, status in _files(Path(folder.path)):
                    sizes[status.st_dev, status.st_ino] = status.st_size
        return sizes


def log_path(stem: Path) -> Path:
    """Return the path of a take that is one file; ``stem`` is without the extension."""
    return stem.with_name(f"{stem.name}{SUFFIX}")


def free_stem(stem: Path, *, has_free_name: bool) -> Path:
    """Return where a new take goes, file or folder: with a number if necessary and allowed.

    Creates the folder of the source. Raises OSError, QueryError.
    """
    stem.parent.mkdir(exist_ok=True)
    candidate, number = stem, 1
    while os.path.lexists(log_path(candidate)) or os.path.lexists(candidate):
        if not has_free_name:
            raise QueryError(f"there is a take {stem.name!r} of this source already; choose another name")
        number += 1
        candidate = stem.with_name(numbered(stem.name, number))
    return candidate


def add_c3d(take: Path, c3d_file: Path) -> Path:
    """Link or copy a C3D file beside a take, under its name, and return its path. Raises TakeError."""
    path, number = take.with_name(f"{take.name}{C3D_SUFFIX}"), 1
    while path.exists():
        number += 1
        path = take.with_name(f"{take.name} ({number}){C3D_SUFFIX}")  # no take can have this name
    try:
        os.link(c3d_file, path)
    except OSError:  # on another file system
        with NewFiles() as files:
            copy = files.create(path)
            with c3d_file.open("rb") as original:
                shutil.copyfileobj(original, copy, _COPIED_BYTES)
    return path


def is_full(error: OSError) -> bool:
    """Return whether room on the disk would help."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


def disk_problem(path: Path, error: OSError) -> str:
    """Return what is wrong with ``path``, and what to do."""
    remedy = _REMEDIES.get(error.errno or 0, "check the disk")
    return f"{path} cannot be written: {error.strerror or error}; {remedy}"


def check_directory(directory: Path) -> None:
    """Check that files can be created in a folder. Raises OSError."""
    if not stat.S_ISDIR(directory.stat().st_mode):
        raise NotADirectoryError(errno.ENOTDIR, "it is not a folder")
    if not os.access(directory, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, "no permission to write in it")


def _source_entries(folder: Path, only: str = "") -> list[TakeEntry]:
    """Return the takes in the folder of a source, or only the one of this name. Raises OSError.

    Symbolic links are left out, because a peer that reads a take must not get any other file.
    """
    takes: dict[str, TakeEntry] = {}
    c3d_files = []
    try:
        children = [] if folder.is_symlink() else [*os.scandir(folder)]
    except FileNotFoundError:
        return []
    for child in children:
        path = Path(child.path)
        if child.name.startswith(only or ".") != bool(only):
            continue
        with contextlib.suppress(FileNotFoundError):
            if child.is_dir(follow_symlinks=False):
                logs = [each for each in _files(path) if each[0].suffix == SUFFIX]
                if logs:
                    takes.setdefault(path.name, TakeEntry(path)).logs += logs
            elif path.suffix == SUFFIX and child.is_file(follow_symlinks=False):
                log = (path, child.stat(follow_symlinks=False))
                takes.setdefault(path.stem, TakeEntry(path.with_suffix(""))).logs.append(log)
            elif path.suffix == C3D_SUFFIX and child.is_file(follow_symlinks=False):
                c3d_files.append((path, child.stat(follow_symlinks=False)))
    for path, status in c3d_files:
        name = path.stem if path.stem in takes else _FURTHER_C3D.sub("", path.stem)
        if name in takes:
            takes[name].c3d_files.append((path, status))
    return [take for name, take in takes.items() if only in {"", name}]


def _files(folder: Path) -> list[tuple[Path, os.stat_result]]:
    files: list[tuple[Path, os.stat_result]] = []
    if folder.is_symlink() or not folder.is_dir():
        return files
    for entry in [*os.scandir(folder)]:
        with contextlib.suppress(FileNotFoundError):
            if entry.is_file(follow_symlinks=False):
                files.append((Path(entry.path), entry.stat(follow_symlinks=False)))
    return sorted(files, key=lambda file: by_number(file[0]))


def _read_take(entry: TakeEntry) -> StoredTake:
    """Read the beginning and the end of a take; all zero if it has no messages."""
    begin_utime = end_utime = num_lost = 0
    is_cut_off = False
    details = NO_DETAILS
    for path, status in entry.logs:
        try:
            beginning = EventLogReader(path).events()
            first = newest = next(beginning)
            second = next(beginning, first)
            tail_bytes = _TAIL_BYTES if path == entry.logs[-1][0] else _END_BYTES
            for event in EventLogReader(path).events(max(0, status.st_size - tail_bytes)):
                newest = event
        except TakeError:
            is_cut_off = True
            continue
        begin_utime, end_utime = begin_utime or first.utime, newest.utime
        described = _decoded(second.message, rtc3d.take_details_t)
        details = details if described is None else decoded_details(described)
        end = _decoded(newest.message, rtc3d.take_end_t)
        if end is not None:
            num_lost += end.messages_lost
        else:
            take = _decoded(first.message, rtc3d.take_t)
            is_cut_off = is_cut_off or (take is not None and has_end(take))
    seconds = max(0.0, (end_utime - begin_utime) / 1e6)
    name, num_bytes = entry.path.name, entry.num_bytes
    return StoredTake(name, num_bytes, begin_utime, seconds, False, num_lost, is_cut_off, details)


def _decoded(message: bytes, message_type: type[Any]) -> Any | None:
    """Return a message, None if it is of another type."""
    try:
        decoded = decode(message)
    except ProtocolError:
        return None
    return decoded if isinstance(decoded, message_type) else None
