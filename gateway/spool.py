"""The folder of C3D files that servers sent: written whole, limited in number and size."""

import logging
import os
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from gateway.errors import SpoolError

_SUFFIX: Final = ".c3d"

logger = logging.getLogger(__name__)


class Spool:
    """Keeps files as DIRECTORY/SOURCE-YYYYMMDDThhmmss.ffffffZ.c3d; the oldest go first.

    Its methods read and write files and wait for the disk: call them in a thread.
    """

    def __init__(self, directory: Path, max_files: int, max_bytes: int) -> None:
        self.directory = directory
        self._max_files = max_files
        self._max_bytes = max_bytes

    def store(self, source: str, content: bytes) -> Path:
        """Write one file, under a temporary name until it is whole; return its path.

        Raises SpoolError if it cannot be written, or is larger than all files together may be.
        """
        if len(content) > self._max_bytes:
            raise SpoolError(
                f"a C3D file of {len(content)} bytes from {source} is not kept: "
                f"spool.max_bytes is {self._max_bytes}"
            )
        name = f"{source}-{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}{_SUFFIX}"
        path = self.directory / name
        temporary = None
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=self.directory, prefix=".", delete=False) as file:
                temporary = Path(file.name)
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
            self._make_room()
        except OSError as error:
            if temporary is not None:
                temporary.unlink(missing_ok=True)
            raise SpoolError(
                f"a C3D file of {len(content)} bytes from {source} cannot be kept in {self.directory}: "
                f"{error.strerror}; check spool.directory and the space on it"
            ) from error
        return path

    def newest(self, source: str) -> Path | None:
        """Return the newest file of ``source``, None if there is none."""
        # The time in the name has a fixed width; a source's name may begin another's.
        length = len(source) + 1 + len("YYYYMMDDThhmmss.ffffffZ") + len(_SUFFIX)
        names = [path.name for path in self._files() if len(path.name) == length]
        own = [name for name in names if name.startswith(f"{source}-")]
        return self.directory / max(own) if own else None

    def _files(self) -> list[Path]:
        return list(self.directory.glob(f"[!.]*{_SUFFIX}"))

    def _make_room(self) -> None:
        """Delete the oldest files beyond the limits."""
        files = sorted(self._files(), key=lambda path: path.name.rsplit("-", 1)[-1], reverse=True)
        kept_bytes = 0
        for number, path in enumerate(files, start=1):
            kept_bytes += path.stat().st_size
            if number > self._max_files or kept_bytes > self._max_bytes:
                logger.info("%s is deleted: spool.max_files or spool.max_bytes is reached", path)
                path.unlink()
