"""Payloads of answers that take long to make: made by the thread that sends them, once for all peers."""

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from gateway.errors import QueryError
from gateway.messages.decode import decode
from gateway.messages.json_text import MAX_JSON_SOURCE_BYTES, json_text

JSON_RATIO: Final = 8
"""How many times as long as its message a JSON text may be, about."""

_UNMADE_S: Final = 0.1
"""For how long further peers share a payload that is not made yet. Then it may belong to an older frame."""


class JsonPayload:
    """JSON that ``make`` returns, made once; ``num_bytes`` is about its size. It implements LazyPayload."""

    def __init__(self, make: Callable[[], bytes], num_bytes: int) -> None:
        self.num_bytes = num_bytes
        self._make = make
        self._lock = threading.Lock()
        self._made: bytes | None = None

    @property
    def is_made(self) -> bool:
        """See LazyPayload."""
        return self._made is not None

    def make(self) -> bytes:
        """See LazyPayload."""
        with self._lock:
            if self._made is None:
                self._made = self._make()
            return self._made


class FilePayload:
    """The content of a file, which is read anew for each peer. It implements LazyPayload."""

    is_made = False

    def __init__(self, path: Path) -> None:
        """Raise OSError if there is no such file."""
        self.name: str = path.name
        self.num_bytes: int = path.stat().st_size
        self._path = path

    def make(self) -> bytes:
        """See LazyPayload."""
        try:
            return self._path.read_bytes()
        except OSError as error:
            text = f"the C3D file {self.name} cannot be read: {error.strerror}"
            raise QueryError(text, code="nothing-yet") from error


class _MessageJson:
    """A message and its JSON text."""

    def __init__(self, message: bytes) -> None:
        self.message = message
        self.payload = JsonPayload(lambda: json_text(decode(message)).encode(), JSON_RATIO * len(message))
        self.begun_s = time.monotonic()


class NewestJson:
    """The JSON texts of the newest messages, one for each key: a message is converted once for all peers.

    While a text waits to be made, peers that ask later share it, so that only one of each key waits.
    """

    def __init__(self) -> None:
        self._newest: dict[str, _MessageJson] = {}

    def of(self, key: str, message: bytes) -> tuple[bytes, JsonPayload]:
        """Return the text of ``message``, or of the one before it, together with its message.

        Raises QueryError if the message is too long.
        """
        newest = self._newest.get(key)
        if newest is None or not (newest.message == message or _is_waiting(newest)):
            if len(message) > MAX_JSON_SOURCE_BYTES:
                raise QueryError(
                    f"a frame of {len(message)} bytes is too long for JSON; ask without format=json",
                    code="refused",
                )
            newest = self._newest[key] = _MessageJson(message)
        return newest.message, newest.payload


def _is_waiting(newest: _MessageJson) -> bool:
    return not newest.payload.is_made and time.monotonic() - newest.begun_s < _UNMADE_S
