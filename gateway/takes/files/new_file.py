"""New files that appear under their names when they are complete."""

import contextlib
import errno
import os
import secrets
from pathlib import Path
from types import TracebackType
from typing import IO, Final, Self

from gateway.errors import TakeError

_BUFFER_BYTES: Final = 1024 * 1024


class NewFiles:
    """One or several new files, which get their names together, when the block ends without an error.

    ::

        with NewFiles() as files:
            file = files.create(Path("walk.csv"))
            file.write(b"...")

    Until then each has a temporary name in the same folder, which ends like its own. If the block fails, or
    if one of the names is taken in the meantime, none of the files remains. Raises TakeError if a file exists
    already, and in place of each OSError of the block, such as a full disk.
    """

    def __init__(self) -> None:
        self.paths: list[Path] = []
        """The files, in the order of their creation."""
        self._temporary: list[Path] = []
        self._replacing: set[Path] = set()
        self._folders: list[Path] = []
        self._locks = contextlib.ExitStack()
        self._open: list[IO[bytes]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            try:
                if error is None:
                    self._publish()
            finally:
                for file in self._open:
                    with contextlib.suppress(OSError):  # the rest of a file that is removed does not fit
                        file.close()
                for temporary in self._temporary:
                    temporary.unlink(missing_ok=True)
                for folder in reversed(self._folders):
                    with contextlib.suppress(OSError):  # it has files: those of this block, or of others
                        folder.rmdir()
                self._locks.close()
        except OSError as failure:
            raise self._as_take_error(failure) from failure
        if isinstance(error, OSError):
            raise self._as_take_error(error) from error

    def create_folder(self, path: Path) -> None:
        """Create a folder unless it exists. If the block fails, it is removed. Raises OSError."""
        if not path.is_dir():
            path.mkdir()
            self._folders.append(path)

    def lock_folder(self, path: Path) -> None:
        """Lock a folder until the block ends. Raises TakeError if another process has locked it."""
        import fcntl  # noqa: PLC0415 - `open_take` also runs on Windows, which has none

        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        self._locks.callback(os.close, descriptor)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise TakeError(f"another program is writing to {path}; try again when it has ended") from None

    def replace(self, path: Path) -> IO[bytes]:
        """Open a file for writing that takes the place of an existing one when the block ends.

        The files get their names in the order of their creation. If one of them cannot, those that are new
        are removed, but what has been replaced stays so.
        """
        self._replacing.add(path)
        return self.create(path)

    def create(self, path: Path) -> IO[bytes]:
        """Open a new file for writing. It has its name when the block ends. Raises TakeError."""
        if path in self.paths or (os.path.lexists(path) and path not in self._replacing):
            raise _exists(path)
        temporary = path.with_name(f".{secrets.token_hex(8)}.part{path.suffix}")
        self.paths.append(path)
        self._temporary.append(temporary)  # first: a signal can end the block as soon as the file exists
        descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        file = os.fdopen(descriptor, "w+b", buffering=_BUFFER_BYTES)
        self._open.append(file)
        return file

    def _publish(self) -> None:
        for file in self._open:
            file.flush()
            os.fsync(file.fileno())
        done: list[Path] = []
        try:
            for temporary, path in zip(self._temporary, self.paths, strict=True):
                if path in self._replacing:
                    temporary.replace(path)
                else:
                    _rename(temporary, path)
                    done.append(path)
        except BaseException:
            for path in done:
                path.unlink(missing_ok=True)
            raise

    def _as_take_error(self, error: OSError) -> TakeError:
        path = error.filename2 or (self.paths[-1] if self.paths else error.filename)
        if isinstance(error, FileExistsError):
            return _exists(path)
        if isinstance(error, FileNotFoundError):
            return TakeError(
                f"{path} cannot be written: there is no folder {Path(path).parent}; create it first"
            )
        return TakeError(f"{path} cannot be written: {error.strerror or error}; nothing was written")


def _rename(temporary: Path, path: Path) -> None:
    """Give a file its name. Raises FileExistsError if the name is taken."""
    try:
        os.link(temporary, path)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links, such as that of a USB stick
        if os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), temporary, None, path) from None
        temporary.rename(path)


def _exists(path: Path | str) -> TakeError:
    return TakeError(f"{path} exists already, and nothing is overwritten; choose another name, or remove it")
