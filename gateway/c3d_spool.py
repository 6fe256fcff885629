"""The folder of C3D files that servers have sent, limited in number and size."""

import contextlib
import logging
import os
import re
import tempfile
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple

from gateway.errors import SpoolError

# Files with other names do not belong to the gateway: it leaves them alone.
_NAME: Final = re.compile(r"(?P<source>.+)-(?P<time>\d{8}T\d{6}\.\d{6}Z)\.c3d")
_UNFINISHED: Final = ".c3d.part"
_ABANDONED_S: Final = 3600.0
"""Older unfinished files were left behind by a gateway that was killed."""

logger = logging.getLogger(__name__)


class _File(NamedTuple):
    time: str  # as in the file name; sorts chronologically
    source: str
    path: Path


class Spool:
    """Stores files as DIRECTORY/SOURCE-YYYYMMDDThhmmss.ffffffZ.c3d, and deletes the oldest ones.

    Its methods block while they read and write files: call them in a thread.
    """

    def __init__(self, directory: Path, max_files: int, max_bytes: int) -> None:
        self.directory = directory
        self._max_files = max_files
        self._max_bytes = max_bytes
        self._deleting = threading.Lock()

    def store(self, source: str, content: bytes) -> Path:
        """Write one file and return its path. Until it is complete, it has a temporary name.

        Raises SpoolError if it cannot be written, or is larger than the limit for all files together.
        """
        if len(content) > self._max_bytes:
            raise SpoolError(
                f"a C3D file of {len(content)} bytes from {source} is not stored: "
                f"spool.max_bytes is {self._max_bytes}"
            )
        path = self.directory / f"{source}-{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}.c3d"
        temporary = None
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=self.directory, suffix=_UNFINISHED, delete=False) as file:
                temporary = Path(file.name)
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except OSError as error:
            if temporary is not None:
                temporary.unlink(missing_ok=True)
            raise SpoolError(
                f"a C3D file of {len(content)} bytes from {source} cannot be stored in {self.directory}: "
                f"{error.strerror}; check spool.directory and the space on it"
            ) from error
        with self._deleting:
            self._delete_old_files()
        return path

    def newest(self, source: str) -> Path | None:
        """Return the newest file of ``source``, None if there is none."""
        own = [file for file in self._files() if file.source == source]
        return max(own).path if own else None

    def _files(self) -> Iterator[_File]:
        for path in self.directory.glob("*.c3d"):
            if name := _NAME.fullmatch(path.name):
                yield _File(name["time"], name["source"], path)

    def _delete_old_files(self) -> None:
        """Delete the oldest files beyond the limits, and abandoned unfinished ones."""
        for path in self.directory.glob(f"*{_UNFINISHED}"):
            with contextlib.suppress(FileNotFoundError):  # another thread has just finished it
                if time.time() - path.stat().st_mtime > _ABANDONED_S:
                    path.unlink()
        kept_bytes = 0
        for number, file in enumerate(sorted(self._files(), reverse=True), start=1):
            try:
                kept_bytes += file.path.stat().st_size
                if number > self._max_files or kept_bytes > self._max_bytes:
                    file.path.unlink()
                    logger.info(
                        "deleted %s, because spool.max_files or spool.max_bytes was reached", file.path
                    )
            except OSError as error:
                logger.warning("cannot delete the old file %s: %s", file.path, error.strerror)
