"""Writing messages to event logs, again and again while the disk does not accept them."""

import threading
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from gateway.losses import Losses
from gateway.outputs.takes.disk import RETRY_S, Disk, is_full
from gateway.outputs.takes.header import FileHeader
from gateway.takes.recording import LogFile, utime_of

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
