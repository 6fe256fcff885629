"""The file of a recording: its name, and its creation. Nothing is overwritten."""

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from gateway.errors import SelectionError, TakeError
from gateway.takes.names import default_name, numbered
from gateway.takes.reader import SUFFIX
from gateway.takes.recording import LogFile

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
