"""The files of one source: they report to the disk and count losses. The running take is one of them."""

import logging
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final

from gateway.errors import QueryError
from gateway.logs.losses import Losses
from gateway.messages.host_time import now_utime
from gateway.outputs.contract import published_again
from gateway.outputs.takes.disk import Disk, is_full
from gateway.takes.files.description import SourceDescription
from gateway.takes.files.new_file import numbered
from gateway.takes.files.reader import SUFFIX
from gateway.takes.files.take_writer import Messages, TakeWriter, begin_log
from gateway.takes.files.writer_thread import LogFile

_CHUNK_MESSAGES: Final = 512
"""How many messages are written at once, so that a segment does not become much too long."""

logger = logging.getLogger(__name__)


class SourceWriter(TakeWriter):
    """Writes the messages of one source. Each of its files begins with the source and its parameters.

    ``parameters`` is the newest ``parameters_t``, or None; it follows what is written.
    """

    def __init__(
        self, description: SourceDescription, parameters: bytes | None, disk: Disk, losses: Losses
    ) -> None:
        super().__init__()
        self.description = description
        self.parameters_channel: bytes = description.channel("parameters")
        self.disk = disk
        self.num_refused = 0
        """How many messages the queue before the disk did not accept. Changed in the event loop only."""
        self._parameters = parameters
        self._num_unwritten = 0  # how many messages the disk did not accept
        self._num_lost_before = 0  # before the present log
        self._losses = losses
        self._is_in_place = True  # whether the present log had its path when this was checked last

    @property
    def num_lost(self) -> int:
        """How many messages were published, but are in no log."""
        return self.num_refused + self._num_unwritten

    def make_room(self, error: OSError) -> bool:
        """See TakeWriter."""
        return is_full(error) and self.delete_less_important()

    def delete_less_important(self) -> bool:
        """Delete what is less important, because the disk is full. Return False if there is nothing."""
        return False

    def succeeded(self) -> None:
        """See TakeWriter."""
        self.disk.succeeded()

    def failed(self, error: OSError) -> None:
        """See TakeWriter."""
        self.disk.failed(self.path, error)

    def write(self, messages: Messages) -> None:
        """See TakeWriter."""
        for start in range(0, len(messages), _CHUNK_MESSAGES):
            chunk = messages[start : start + _CHUNK_MESSAGES]
            super().write(chunk)
            newest = dict(chunk).get(self.parameters_channel)
            if newest is not None:
                self._parameters = newest

    def sync(self) -> None:
        """See TakeWriter."""
        super().sync()
        if self._log is not None:
            self._is_in_place = self._log.is_in_place()

    def _begin_log(self, path: Path, name: str, utime: int) -> LogFile:
        """Create a file of the take ``name``. Raises OSError; then there is no file."""
        messages = self.description.beginning(name, utime)
        if self._parameters is not None:
            messages.append((self.parameters_channel, published_again(self._parameters, utime)))
        return begin_log(path, messages)

    def _close_log(self) -> LogFile | None:
        """End the present log with what is missing in it, store everything, close it and return it."""
        utime, num_lost = now_utime(), self.num_lost - self._num_lost_before
        log = self.end_log(lambda num_removed: [self.description.end(utime, num_lost + num_removed)])
        if log is not None:
            self._num_lost_before = self.num_lost
        return log

    def lose(self, messages: Messages) -> None:
        """See TakeWriter."""
        self._count_lost(len(messages), max(Counter(channel for channel, _ in messages).values()))

    def lose_newest(self, error: OSError) -> None:  # noqa: ARG002 - the disk knows what is wrong
        """See TakeWriter."""
        self._count_lost(1, 1)

    def _count_lost(self, num_messages: int, num_frames: int) -> None:
        self._num_unwritten += num_messages
        text = self.disk.problem or f"the disk of {self.path} is full"
        self._losses.lost("not written", text, messages=num_messages, frames=num_frames)


class TakeFile(SourceWriter):
    """The running take of a source. Its file exists from ``create`` on; what is written before is ignored.

    ``stem`` is its path without the extension. If ``has_free_name``, a number is added if there is such a
    take already. On a full disk, ``delete_less_important`` makes room; it returns False if it cannot.
    """

    def __init__(
        self,
        stem: Path,
        utime: int,
        *,
        has_free_name: bool,
        description: SourceDescription,
        parameters: bytes | None,
        disk: Disk,
        losses: Losses,
        delete_less_important: Callable[[], bool] = lambda: False,
    ) -> None:
        super().__init__(description, parameters, disk, losses)
        self._delete_less_important = delete_less_important
        self._folder = stem.parent
        self.name = stem.name
        """The name of the take; final after ``create``."""
        self.utime = utime
        """When it was started, in µs since the Unix epoch."""
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
        self._log = self._begin_log(self.path, self.name, self.utime)

    def delete_less_important(self) -> bool:
        """See SourceWriter."""
        return self._delete_less_important()

    def cancel(self) -> None:
        """Do not create the file, because nobody waits for it any more. Any thread may call it."""
        self._is_cancelled = True
        self.give_up()

    def log_for(self, utime: int) -> LogFile:
        """See TakeWriter. If the file was removed, another one takes its place."""
        log = self._log
        assert log is not None  # noqa: S101 - see write
        if not self._is_in_place and not log.is_in_place():
            self._folder.mkdir(exist_ok=True)
            self._log, removed = self._begin_log(self.path, self.name, utime), log
            removed.close()
            logger.warning(
                "takes: %s was removed while it was recorded; the take continues in a new file", self.path
            )
            log = self._log
        self._is_in_place = True
        return log

    def write(self, messages: Messages) -> None:
        """See TakeWriter."""
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
