"""The file of a take that was started and is not stopped yet."""

import logging
from collections.abc import Callable
from pathlib import Path

from gateway.errors import QueryError
from gateway.losses import Losses
from gateway.outputs.takes.disk import Disk
from gateway.outputs.takes.header import FileHeader
from gateway.outputs.takes.log_sink import LogSink, Messages
from gateway.takes.names import numbered
from gateway.takes.reader import SUFFIX
from gateway.takes.recording import LogFile

logger = logging.getLogger(__name__)


class TakeFile(LogSink):
    """The running take of a source. Its file exists from ``create`` on; what is written before is ignored.

    If ``has_free_name``, a number is added to ``name`` if there is such a take already. On a full disk,
    ``make_room`` deletes what is less important; it returns False if there is nothing.
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        utime: int,
        *,
        has_free_name: bool,
        header: FileHeader,
        disk: Disk,
        losses: Losses,
        make_room: Callable[[], bool] = lambda: False,
    ) -> None:
        super().__init__(header, disk, losses)
        self._make_room = make_room
        self.name = name
        """The name of the take; final after ``create``."""
        self.utime = utime
        """When it was started, in µs since the Unix epoch."""
        self._folder = folder
        self._has_free_name = has_free_name
        self._is_cancelled = False

    @property
    def path(self) -> Path:
        """The path of the file."""
        return self._folder / f"{self.name}{SUFFIX}"

    @property
    def stem(self) -> Path:
        """The path without the extension."""
        return self._folder / self.name

    def create(self) -> None:
        """Create the file. Raises OSError, and QueryError if there is such a take already."""
        if self._is_cancelled:
            return
        self._folder.mkdir(exist_ok=True)
        name, number = self.name, 1
        while self.path.exists() or self.stem.exists():
            if not self._has_free_name:
                raise QueryError(f"there is a take {name!r} of this source already; choose another name")
            number += 1
            self.name = numbered(name, number)
        self._log = self.header.begin_log(self.path, self.name, self.utime)

    def make_room(self) -> bool:
        """See LogSink."""
        return self._make_room()

    def cancel(self) -> None:
        """Do not create the file, because nobody waits for it any more. Any thread may call it."""
        self._is_cancelled = True
        self.give_up()

    def log_for(self, utime: int) -> LogFile:
        """See LogSink. If the file was removed, another one takes its place."""
        log = self._log
        assert log is not None  # noqa: S101 - see write
        if not self._is_in_place and not log.is_in_place():
            self._folder.mkdir(exist_ok=True)
            self._log, removed = self.header.begin_log(self.path, self.name, utime), log
            removed.close()
            logger.warning(
                "takes: %s was removed while it was recorded; the take continues in a new file", self.path
            )
            log = self._log
        self._is_in_place = True
        return log

    def write(self, messages: Messages) -> None:
        """See LogSink."""
        if self._log is not None:
            super().write(messages)

    def discard(self) -> None:
        """End the take and delete its file, because it was cancelled."""
        log = self._log
        self.end()
        if log is not None:
            log.path.unlink(missing_ok=True)

    def end(self) -> None:
        """Store everything and close the file."""
        if self._close_log() is not None:
            self.disk.ended()
