"""The file of a recording: written again until the disk accepts it."""

import contextlib
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from gateway.takes.recording import LogFile

Messages = Sequence[tuple[bytes, bytes]]
"""Messages, each with its channel."""

RETRY_S: Final = 0.25


class FileSink:
    """Writes messages to ``log``. What the disk does not accept waits, and the queue behind it fills.

    ``write`` and ``sync`` are called in the thread that writes, the others in any thread.
    """

    def __init__(self, log: LogFile) -> None:
        self.problem = ""
        """What is wrong with the disk now; "" if it accepts messages."""
        self.lost: Counter[bytes] = Counter()
        """How many messages the disk has not accepted in the end, by channel."""
        self.lost_bytes: Counter[bytes] = Counter()
        self.num_errors = 0
        """How often the disk stopped accepting messages."""
        self.is_unsafe = False
        """Whether the disk reported that something written before may be lost."""
        self._log = log
        self._gives_up = threading.Event()

    @property
    def path(self) -> Path:
        """The path of the file."""
        return self._log.path

    @property
    def is_in_place(self) -> bool:
        """Whether the file still has its path. Do not call it after ``close``."""
        return self._log.is_in_place()

    @property
    def num_bytes(self) -> int:
        """The size of the file."""
        return self._log.num_bytes

    def give_up(self) -> None:
        """Try once more and then lose what the disk does not accept, because the recording ends."""
        self._gives_up.set()

    def write(self, messages: Messages) -> None:
        """Write messages; wait while the disk does not accept them."""
        rest = messages
        while rest:
            gives_up = self._gives_up.is_set()
            try:
                rest = rest[self._log.append(rest) :]
            except OSError as error:
                self._failed(error)
                if gives_up:
                    for channel, message in rest:
                        self.lost[channel] += 1
                        self.lost_bytes[channel] += len(message)
                    return
                self._gives_up.wait(RETRY_S)
            else:
                self.problem = ""

    def _failed(self, error: OSError) -> None:
        if not self.problem:
            self.num_errors += 1
        self.problem = f"{self.path} cannot be written: {error.strerror or error}"

    def sync(self) -> None:
        """Store on the disk what was written."""
        try:
            self._log.sync()
        except OSError as error:
            self.is_unsafe = True
            self._failed(error)

    def end(self, ends: Callable[[int], Messages]) -> None:
        """Write the last messages of the file, after the thread that writes has ended.

        On a full disk, they take the place of the newest message. ``ends`` returns them; it takes how many
        messages were removed.
        """
        try:
            self._append(ends(0))
        except OSError as error:
            self._failed(error)
            with contextlib.suppress(OSError):  # the file looks as if it were cut off, which is true
                self._log.remove_newest()
                self._append(ends(1))

    def _append(self, messages: Messages) -> None:
        while messages:
            messages = messages[self._log.append(messages) :]

    def close(self) -> None:
        """Close the file, after the thread that writes has ended."""
        try:
            self._log.close()
        except OSError as error:
            self.is_unsafe = True
            self._failed(error)
