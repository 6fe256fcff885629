"""The file of a take: what it begins and ends with, and writing it again and again while the disk refuses."""

import logging
import threading
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gateway import __version__
from gateway.errors import QueryError
from gateway.logs.losses import Losses
from gateway.messages.host_time import now_utime
from gateway.messages.topics import lcm_channel
from gateway.outputs.parameters_message import published_again
from gateway.outputs.takes.disk import RETRY_S, Disk, is_full
from gateway.takes.files.description import (
    NO_DETAILS,
    TakeDetails,
    encode_take,
    encode_take_details,
    encode_take_end,
)
from gateway.takes.files.new_file import numbered
from gateway.takes.files.reader import SUFFIX
from gateway.takes.files.recording import LogFile, utime_of


@dataclass(frozen=True)
class SourceDescription:
    """A source in the files of a take. ``server`` is HOST:PORT, "" if it is not known."""

    source: str
    prefix: str
    server: str
    details: TakeDetails = NO_DETAILS

    def channel(self, *path: str) -> bytes:
        """Return the channel of the key with this path."""
        return lcm_channel(self.prefix, self.source, *path).encode()

    def messages(self, name: str, utime: int) -> list[tuple[bytes, bytes]]:
        """Return what describes the source in a file that begins at ``utime``, in µs since the Unix epoch."""
        take = encode_take(
            utime=utime,
            name=name,
            source=self.source,
            channels=lcm_channel(self.prefix, self.source),
            server=self.server,
            gateway_version=__version__,
            recorder="rtc3d-gateway",
        )
        messages = [(self.channel("take"), take)]
        if self.details != NO_DETAILS:
            details = encode_take_details(utime=utime, source=self.source, details=self.details)
            messages.append((self.channel("details"), details))
        return messages

    def end_message(self, utime: int, num_lost: int) -> bytes:
        """Return the ``take_end_t`` of a file that ends at ``utime`` and lacks ``num_lost`` messages."""
        return encode_take_end(utime=utime, source=self.source, messages_lost=num_lost)


class FileHeader:
    """The beginning of the files of one source.

    ``parameters`` is the newest ``parameters_t``, or None. It is used in the thread that writes,
    where ``parameters`` follows what is written.
    """

    def __init__(self, description: SourceDescription, parameters: bytes | None) -> None:
        self.description = description
        self.parameters = parameters
        self.parameters_channel: bytes = description.channel("parameters")
        self._end_channel = description.channel("end")

    def messages(self, name: str, utime: int) -> list[tuple[bytes, bytes]]:
        """Return the first messages of a file, each with its channel."""
        messages = self.description.messages(name, utime)
        if self.parameters is not None:
            messages.append((self.parameters_channel, published_again(self.parameters, utime)))
        return messages

    def begin_log(self, path: Path, name: str, utime: int) -> LogFile:
        """Create a file with these messages. Raises OSError; then there is no file."""
        messages = self.messages(name, utime)
        log = LogFile(path)
        try:
            while messages:
                messages = messages[log.append(messages) :]
        except OSError:
            log.close()
            path.unlink(missing_ok=True)
            raise
        return log

    def end_log(self, log: LogFile, num_lost: int) -> int:
        """Write the last message of a file; on a full disk, in place of the newest one.

        Returns how many messages the file lacks then. Raises OSError.
        """
        utime = now_utime()
        try:
            log.append([(self._end_channel, self.description.end_message(utime, num_lost))])
        except OSError:
            log.remove_newest()
            num_lost += 1
            log.append([(self._end_channel, self.description.end_message(utime, num_lost))])
        return num_lost


Messages = Sequence[tuple[bytes, bytes]]
"""Messages of the gateway, each with its channel."""

_CHUNK_MESSAGES: Final = 512
"""How many messages are written at once, so that a segment does not become much too long."""


class LogSink(ABC):
    """Writes the messages of one source to event logs; what the disk does not accept is written again.

    Meanwhile, the queue before it fills, and then the output refuses further messages. Its methods are called
    in the thread that writes, except for ``give_up``.
    """

    def __init__(self, header: FileHeader, disk: Disk, losses: Losses) -> None:
        self.header = header
        self.disk = disk
        self.num_refused = 0
        """How many messages the queue before the disk did not accept. Changed in the event loop only."""
        self._num_unwritten = 0  # how many messages the disk did not accept
        self._num_lost_before = 0  # before the present log
        self._losses = losses
        self._log: LogFile | None = None  # the present one
        self._is_in_place = True
        """Whether the present log had its path when this was checked last."""
        self._gives_up = threading.Event()

    @property
    def num_lost(self) -> int:
        """How many messages were published, but are in no log."""
        return self.num_refused + self._num_unwritten

    @property
    @abstractmethod
    def path(self) -> Path:
        """The file or folder that is written, for messages."""

    @abstractmethod
    def log_for(self, utime: int) -> LogFile:
        """Return the log for messages from ``utime`` on, in µs since the Unix epoch. Raises OSError."""

    def make_room(self) -> bool:
        """Delete what is less important, because the disk is full. Return False if there is nothing."""
        return False

    def _waits_for(self, error: OSError) -> bool:  # noqa: ARG002 - for those that override it
        """Return whether to write again what the disk did not accept, or to lose it at once."""
        return True

    def give_up(self) -> None:
        """Lose what the disk does not accept at once from now on. Any thread may call it."""
        self._gives_up.set()

    def write(self, messages: Messages) -> None:
        """Write messages; wait while the disk does not accept them."""
        for start in range(0, len(messages), _CHUNK_MESSAGES):
            chunk = messages[start : start + _CHUNK_MESSAGES]
            self._write(chunk)
            newest = dict(chunk).get(self.header.parameters_channel)
            if newest is not None:
                self.header.parameters = newest

    def _write(self, messages: Messages) -> None:
        rest = messages
        while rest:
            try:
                log = self.log_for(utime_of(rest[0][1]))
                rest = rest[log.append(rest) :]
            except OSError as error:
                if is_full(error) and self.make_room():
                    continue
                self.disk.failed(self.path, error)
                if not self._waits_for(error) or self._gives_up.wait(RETRY_S):
                    self.lose(rest)
                    break
            else:
                self.disk.succeeded()

    def sync(self) -> None:
        """Store on the disk what was written."""
        if self._log is not None:
            try:
                self._log.sync()
            except OSError as error:
                self.disk.failed(self.path, error)
            self._is_in_place = self._log.is_in_place()

    def _close_log(self) -> LogFile | None:
        """End the present log with what is missing in it, store everything, close it and return it."""
        log, self._log = self._log, None
        if log is not None:
            num_lost = self.num_lost - self._num_lost_before
            try:
                self._count_lost(self.header.end_log(log, num_lost) - num_lost)
            except OSError as error:
                self.disk.failed(self.path, error)
                self._count_lost(1)  # the newest message, which has made room in vain
            self._num_lost_before = self.num_lost
            try:
                log.close()
            except OSError as error:
                self.disk.failed(self.path, error)
        return log

    def lose(self, messages: Messages) -> None:
        """Count messages that are not written."""
        self._count_lost(len(messages), max(Counter(channel for channel, _ in messages).values()))

    def _count_lost(self, num_messages: int, num_frames: int = 1) -> None:
        if num_messages:
            self._num_unwritten += num_messages
            text = self.disk.problem or f"the disk of {self.path} is full"
            self._losses.lost("not written", text, messages=num_messages, frames=num_frames)


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
