"""The files of one source: they report to the disk and count losses. The running take is one of them."""

import contextlib
import logging
from collections import Counter
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Final, NamedTuple

from typing_extensions import override

from gateway.messages.host_time import now_utime
from gateway.outputs.contract import published_again
from gateway.outputs.takes.disk import Disk
from gateway.outputs.takes.folder import free_stem, is_full, log_path
from gateway.outputs.takes.publisher import TakesPublisher
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.runtime.losses import Losses
from gateway.takes.files.description import SourceDescription
from gateway.takes.files.take_writer import Messages, TakeWriter, begin_log
from gateway.takes.files.writer_thread import LogFile

_CHUNK_MESSAGES: Final = 512
"""How many messages are written at once, so that a segment does not become much too long."""

logger = logging.getLogger(__name__)


class SourceFacts(NamedTuple):
    """What a source is, which of its components are recorded, and who learns of problems and losses.

    ``parameters`` is the newest ``parameters_t``, or None.
    """

    description: SourceDescription
    parameters: bytes | None
    disk: Disk
    losses: Losses
    components: Collection[ComponentType] = WIRE_ORDER


class SourceWriter(TakeWriter):
    """Writes the messages of one source. Each of its files begins with the source and its parameters."""

    def __init__(self, path: Path, facts: SourceFacts) -> None:
        super().__init__(path)
        self.description, self._parameters, self.disk, self._losses, self.components = facts
        self.parameters_channel: bytes = self.description.channel("parameters")
        self.channels: dict[TakesPublisher, str] = {}
        """The channel of each publisher. Used in the event loop only."""
        self.num_refused = 0
        """How many messages the queue before the disk did not accept. Changed in the event loop only."""
        self._num_unwritten = 0  # how many messages the disk did not accept
        self._num_lost_before = 0  # before the present log
        self._is_in_place = True  # whether the present log had its path when this was checked last

    @property
    def num_lost(self) -> int:
        """How many messages were published, but are in no log."""
        return self.num_refused + self._num_unwritten

    @override
    def succeeded(self) -> None:
        self.disk.succeeded()

    @override
    def failed(self, error: OSError) -> None:
        self.disk.failed(self.path, error)

    @override
    def write(self, messages: Messages) -> None:
        for start in range(0, len(messages), _CHUNK_MESSAGES):
            chunk = messages[start : start + _CHUNK_MESSAGES]
            super().write(chunk)
            newest = dict(chunk).get(self.parameters_channel)
            if newest is not None:
                self._parameters = newest

    @override
    def sync(self) -> None:
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

    @override
    def lose(self, messages: Messages) -> None:
        self._count_lost(len(messages), max(Counter(channel for channel, _ in messages).values()))

    @override
    def lose_newest(self, error: OSError) -> None:
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
        facts: SourceFacts,
        *,
        has_free_name: bool,
        delete_less_important: Callable[[], bool],
    ) -> None:
        super().__init__(log_path(stem), facts)
        self._delete_less_important = delete_less_important
        self.stem = stem
        """The path without the extension; final after ``create``."""
        self.utime = utime
        """When it was started, in µs since the Unix epoch."""
        self._has_free_name = has_free_name

    @property
    def name(self) -> str:
        """The name of the take."""
        return self.stem.name

    def create(self) -> None:
        """Create the file. Raises OSError, and QueryError if there is such a take already."""
        self.stem = free_stem(self.stem, has_free_name=self._has_free_name)
        self.path = log_path(self.stem)
        self._log = self._begin_log(self.path, self.name, self.utime)

    @override
    def make_room(self, error: OSError) -> bool:
        return is_full(error) and self._delete_less_important()

    @override
    def log_for(self, utime: int) -> LogFile:
        """If the file was removed, another one takes its place.

        That has another name if somebody has put something else there: the take is renamed.
        """
        log = self._log
        assert log is not None  # noqa: S101 - see write
        if not self._is_in_place and not log.is_in_place():
            stem = free_stem(self.stem, has_free_name=True)
            self._log, removed = self._begin_log(log_path(stem), stem.name, utime), log
            self.stem, self.path = stem, self._log.path
            logger.warning(
                "takes: %s was removed while it was recorded; the take continues in %s",
                *(removed.path, self.path),
            )
            with contextlib.suppress(OSError):  # nobody finds the file any more
                removed.close()
            log = self._log
        self._is_in_place = True
        return log

    @override
    def write(self, messages: Messages) -> None:
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
