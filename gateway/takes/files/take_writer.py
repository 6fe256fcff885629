"""A take that is being written: begun, written again while the disk refuses, and ended with what it lacks.

The gateway's own takes (``gateway.outputs.takes``) and the recordings of a subscriber
(``gateway.client.recorder``) have different files, and report problems to different places. The rest is here.
"""

import contextlib
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from gateway.messages.history import utime_of
from gateway.takes.files.writer_thread import LogFile

RETRY_S: Final = 0.25
"""How often what the disk did not accept is written again."""

Messages = Sequence[tuple[bytes, bytes]]
"""Messages of the gateway, each with its channel."""


def begin_log(path: Path, messages: Messages) -> LogFile:
    """Create a file that begins with these messages. Raises OSError; then there is no file."""
    log = LogFile(path)
    try:
        _append_all(log, messages)
    except OSError:
        with contextlib.suppress(OSError):  # such as the one that was reported when it was written
            log.close()
        path.unlink(missing_ok=True)
        raise
    return log


class TakeWriter(ABC):
    """Writes a take to event logs, one after the other. What the disk does not accept is written again.

    Meanwhile, the queue of the WriterThread fills, and then it refuses further messages. All methods are
    called in that thread, except for ``give_up``.
    """

    def __init__(self, path: Path, log: LogFile | None = None) -> None:
        self.path = path
        """The file or folder that is written, for messages."""
        self.is_unsafe = False
        """Whether the disk reported that something written before may be lost."""
        self._log = log  # the present one
        self._gives_up = threading.Event()

    @abstractmethod
    def log_for(self, utime: int) -> LogFile:
        """Return the log for messages from ``utime`` on, in µs since the Unix epoch. Raises OSError."""

    @abstractmethod
    def succeeded(self) -> None:
        """Note that the disk has accepted messages."""

    @abstractmethod
    def failed(self, error: OSError) -> None:
        """Note that the disk has not accepted messages."""

    @abstractmethod
    def lose(self, messages: Messages) -> None:
        """Count messages that are not written."""

    @abstractmethod
    def lose_newest(self, error: OSError) -> None:
        """Count the newest message, which was removed to make room for the end; ``error`` says why."""

    def written(self, begin: int, messages: Messages) -> None:  # noqa: B027 - optional
        """Note that messages are in the present log, from ``begin`` on, in bytes. By default, do nothing."""

    def make_room(self, error: OSError) -> bool:  # noqa: ARG002 - for those that override it
        """Delete what is less important; return whether to write again at once what was not accepted."""
        return False

    def waits_for_room(self, error: OSError) -> bool:  # noqa: ARG002 - for those that override it
        """Return whether to write again, a little later, what was not accepted, or to lose it at once."""
        return True

    def give_up(self) -> None:
        """Try once more and then lose what the disk does not accept. Any thread may call it."""
        self._gives_up.set()

    def write(self, messages: Messages) -> None:
        """Write messages; wait while the disk does not accept them."""
        rest = messages
        while rest:
            is_last_try = self._gives_up.is_set()
            try:
                log = self.log_for(utime_of(rest[0][1]))
                begin = log.num_bytes
                num_written = log.append(rest)
            except OSError as error:
                if self.make_room(error):
                    continue
                self.failed(error)
                if is_last_try or not self.waits_for_room(error):
                    self.lose(rest)
                    return
                self._gives_up.wait(RETRY_S)
            else:
                self.succeeded()
                self.written(begin, rest[:num_written])
                rest = rest[num_written:]

    def sync(self) -> None:
        """Store on the disk what was written."""
        if self._log is not None:
            try:
                self._log.sync()
            except OSError as error:
                self.is_unsafe = True
                self.failed(error)

    def end_log(self, ends: Callable[[int], Messages]) -> LogFile | None:
        """Write the last messages of the present log, store everything, close it and return it.

        On a full disk, they take the place of the newest message. ``ends`` returns them; it takes how many
        messages were removed.
        """
        log, self._log = self._log, None
        if log is None:
            return None
        try:
            _append_all(log, ends(0))
        except OSError as error:
            try:
                log.remove_newest()
                _append_all(log, ends(1))
            except OSError as again:  # the file looks as if it were cut off, which is true
                self.failed(again)
            self.lose_newest(error)
        try:
            log.close()
        except OSError as error:
            self.is_unsafe = True
            self.failed(error)
        return log


def _append_all(log: LogFile, messages: Messages) -> None:
    while messages:
        messages = messages[log.append(messages) :]
