"""The folder for the C3D files that servers send, limited in number and total size."""

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

# Files with other names belong to somebody else and stay untouched.
_FILE_NAME: Final = re.compile(r"(?P<source>.+)-(?P<time>\d{8}T\d{6}\.\d{6}Z)\.c3d")
_UNFINISHED_SUFFIX: Final = ".c3d.part"
_UNFINISHED_MAX_AGE_S: Final = 3600.0
"""An older unfinished file was left behind by a gateway that was killed."""

logger = logging.getLogger(__name__)


class _StoredFile(NamedTuple):
    time: str  # sorts by time
    source: str
    path: Path


class Spool:
    """Stores files as DIRECTORY/SOURCE-YYYYMMDDThhmmss.ffffffZ.c3d and deletes the oldest beyond the limits.

    The methods wait for the disk: call them in a thread. Any number of threads may call them.
    """

    def __init__(self, directory: Path, max_files: int, max_bytes: int) -> None:
        self.directory = directory
        self._max_files = max_files
        self._max_bytes = max_bytes
        self._cleanup_lock = threading.Lock()

    def store(self, source: str, content: bytes) -> Path:
        """Write a file and return its path; until it is complete it has a temporary name.

        Raises SpoolError if it cannot be written, or if it alone is larger than the limit for all files.
        """
        if len(content) > self._max_bytes:
            raise SpoolError(
                f"a C3D file of {len(content)} bytes from {source} is too large to keep: "
                f"spool.max_bytes is {self._max_bytes}"
            )
        path = self.directory / f"{source}-{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}.c3d"
        temporary = None
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(
                dir=self.directory, suffix=_UNFINISHED_SUFFIX, delete=False
            ) as file:
                temporary = Path(file.name)
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except OSError as error:
            if temporary is not None:
                temporary.unlink(missing_ok=True)
            raise SpoolError(
                f"a C3D file of {len(content)} bytes from {source} cannot be kept in {self.directory}: "
                f"{error.strerror}; check spool.directory and its free space"
            ) from error
        with self._cleanup_lock:
            self._delete_oldest()
        return path

    def newest(self, source: str) -> Path | None:
        """Return the newest file of ``source``, or None if there is none."""
        files = [file for file in self._files() if file.source == source]
        return max(files).path if files else None

    def _files(self) -> Iterator[_StoredFile]:
        for path in self.directory.glob("*.c3d"):
            if name := _FILE_NAME.fullmatch(path.name):
                yield _StoredFile(name["time"], name["source"], path)

    def _delete_oldest(self) -> None:
        """Delete the oldest files beyond the limits, and abandoned unfinished files."""
        for path in self.directory.glob(f"*{_UNFINISHED_SUFFIX}"):
            with contextlib.suppress(FileNotFoundError):  # another thread has just renamed it
                if time.time() - path.stat().st_mtime > _UNFINISHED_MAX_AGE_S:
                    path.unlink()
        total_bytes = 0
        for number, file in enumerate(sorted(self._files(), reverse=True), start=1):
            try:
                total_bytes += file.path.stat().st_size
                if number > self._max_files or total_bytes > self._max_bytes:
                    file.path.unlink()
                    logger.info("deleted %s: spool.max_files or spool.max_bytes is reached", file.path)
            except OSError as error:
                logger.warning("cannot delete the old file %s: %s", file.path, error.strerror)
