"""The file of a recording: its name, its creation, and writing it again until the disk accepts it."""

import contextlib
import os
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from gateway.errors import SelectionError, TakeError
from gateway.takes.files.new_file import default_name, numbered
from gateway.takes.files.reader import SUFFIX
from gateway.takes.files.recording import LogFile

_MAX_NAMED: Final = 3
"""The default name has the names of at most this many sources."""


class Target:
    """Where to record: a file, which is created at once, or a folder, where the name follows the sources.

    Raises TakeError if nothing can be recorded there.
    """

    def __init__(self, path: Path) -> None:
        self._folder: Path | None = None
        self._log: LogFile | None = None
        if _is_dir(path):
            if not os.access(path, os.W_OK | os.X_OK):
                raise TakeError(f"no permission to write in the folder {path}; choose another one")
            self._folder = path
            return
        if path.suffix not in {"", SUFFIX}:
            raise SelectionError(
                f"{path}: recordings are LCM event logs; choose a name that ends with {SUFFIX}, "
                "and convert it afterwards (rtc3d-gateway export)"
            )
        self._log = _create(path.with_suffix(SUFFIX))

    def open(self, sources: Sequence[str]) -> LogFile:
        """Return the new file, named after the sources if it is in a folder. Raises TakeError."""
        if self._log is None:
            assert self._folder is not None  # noqa: S101 - there is one of both
            self._log = _create_free(self._folder, default_name(_names(sources)))
        return self._log

    def discard_empty(self) -> None:
        """Remove the file if nothing was written, so that its name is free for the next attempt."""
        if self._log is not None:
            with contextlib.suppress(OSError):
                if not self._log.path.stat().st_size:
                    self._log.path.unlink()


def _is_dir(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:
        return False  # a name that is too long: creating it says so


def _names(sources: Sequence[str]) -> str:
    """Return up to three sources, joined by "+"; of more, only their number."""
    return "+".join(sources) if len(sources) <= _MAX_NAMED else f"{len(sources)}-sources"


def _create_free(folder: Path, name: str) -> LogFile:
    number = 1
    while True:
        path = folder / f"{numbered(name, number)}{SUFFIX}"
        if not os.path.lexists(path):
            return _create(path)
        number += 1


def _create(path: Path) -> LogFile:
    try:
        return LogFile(path)
    except FileExistsError:
        raise TakeError(
            f"{path} exists already, and nothing is overwritten; choose another name, or a folder"
        ) from None
    except FileNotFoundError as error:
        raise TakeError(f"there is no folder {path.parent}; create it first") from error
    except OSError as error:
        raise TakeError(f"{path} cannot be created: {error.strerror or error}") from error


Messages = Sequence[tuple[bytes, bytes]]
"""Messages, each with its channel."""

RETRY_S: Final = 0.25


class FileSink:
    """Writes messages to ``log``. What the disk does not accept waits, and the queue behind it fills.

    ``write`` and ``sync`` are called in the thread that writes, the others in any thread.
    """

    def __init__(self, log: LogFile) -> None:
        self.problem = ""
        """What is wrong with the disk now; "" if it accepts messages."""
        self.lost: Counter[bytes] = Counter()
        """How many messages the disk has not accepted in the end, by channel."""
        self.lost_bytes: Counter[bytes] = Counter()
        self.num_errors = 0
        """How often the disk stopped accepting messages."""
        self.is_unsafe = False
        """Whether the disk reported that something written before may be lost."""
        self._log = log
        self._gives_up = threading.Event()

    @property
    def path(self) -> Path:
        """The path of the file."""
        return self._log.path

    @property
    def is_in_place(self) -> bool:
        """Whether the file still has its path. Do not call it after ``close``."""
        return self._log.is_in_place()

    @property
    def num_bytes(self) -> int:
        """The size of the file."""
        return self._log.num_bytes

    def give_up(self) -> None:
        """Try once more and then lose what the disk does not accept, because the recording ends."""
        self._gives_up.set()

    def write(self, messages: Messages) -> None:
        """Write messages; wait while the disk does not accept them."""
        rest = messages
        while rest:
            gives_up = self._gives_up.is_set()
            try:
                rest = rest[self._log.append(rest) :]
            except OSError as error:
                self._failed(error)
                if gives_up:
                    for channel, message in rest:
                        self.lost[channel] += 1
                        self.lost_bytes[channel] += len(message)
                    return
                self._gives_up.wait(RETRY_S)
            else:
                self.problem = ""

    def _failed(self, error: OSError) -> None:
        if not self.problem:
            self.num_errors += 1
        self.problem = f"{self.path} cannot be written: {error.strerror or error}"

    def sync(self) -> None:
        """Store on the disk what was written."""
        try:
            self._log.sync()
        except OSError as error:
            self.is_unsafe = True
            self._failed(error)

    def end(self, ends: Callable[[int], Messages]) -> None:
        """Write the last messages of the file, after the thread that writes has ended.

        On a full disk, they take the place of the newest message. ``ends`` returns them; it takes how many
        messages were removed.
        """
        try:
            self._append(ends(0))
        except OSError as error:
            self._failed(error)
            with contextlib.suppress(OSError):  # the file looks as if it were cut off, which is true
                self._log.remove_newest()
                self._append(ends(1))

    def _append(self, messages: Messages) -> None:
        while messages:
            messages = messages[self._log.append(messages) :]

    def close(self) -> None:
        """Close the file, after the thread that writes has ended."""
        try:
            self._log.close()
        except OSError as error:
            self.is_unsafe = True
            self._failed(error)
