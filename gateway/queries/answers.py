"""Answers that need no server: schemas, messages as they are, parameters as JSON."""

import threading
import time
from collections.abc import Callable, Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import rtc3d

from gateway.errors import QueryError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.decode import (
    JSON,
    LCM,
    MAX_JSON_SOURCE_BYTES,
    TEXT,
    decode,
    json_bytes,
    json_text,
    message_type,
)
from gateway.outputs.contract import Answer
from gateway.rtc3d.parameters import SECTIONS, Parameters


@cache
def schema_answer(name: str) -> Answer:
    """Return the ``.lcm`` text of a type for lcm-gen; the types that it contains come first."""
    texts = [
        (files("rtc3d") / f"{each}.lcm").read_text(encoding="utf-8") for each in _with_member_types(name)
    ]
    return Answer("\n".join(texts).encode(), TEXT)


def _with_member_types(name: str) -> list[str]:
    """Return the names of all types that a type contains, each once, and then its own."""
    names: dict[str, None] = {}
    for type_name in getattr(rtc3d, name).__typenames__:
        package, _, member = type_name.rpartition(".")
        if package:
            names |= dict.fromkeys(_with_member_types(member))
    return [*names, name]


def message_answer(message: bytes, attachment: Mapping[str, Any]) -> Answer:
    """Return a message of the gateway as it is published."""
    return Answer(message, f"{LCM};rtc3d.{message_type(message).__name__}", attachment)


def parameters_json(parameters: Parameters, section: str) -> bytes | None:
    """Return parameters as JSON with NaN as null: an object of all sections, or the object of one.

    Returns None if the parameters lack ``section``.
    """
    values = {key: section.of(parameters) for key, section in SECTIONS.items()}
    if section:
        return None if values[section] is None else json_text(values[section]).encode()
    return json_text({name: value for name, value in values.items() if value is not None}).encode()


FRAME_KEY: Final = "frame"


def frame_answer(
    frame: CoordinateFrame, names: Mapping[str, Mapping[str, Mapping[str, str]]], options: Mapping[str, str]
) -> Answer:
    """Return the frame, and the names that outputs have given to items, as JSON.

    ``names`` are by output, component key and label. Raises QueryError if there are options.
    """
    if options:
        raise QueryError(f"{FRAME_KEY} takes no options")
    given = {output: of_output for output, of_output in names.items() if of_output}
    return Answer(json_bytes({**frame.facts, "names": given}), JSON)


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


class NewestJson:
    """The JSON texts of the newest messages, one for each key: a message is converted once for all peers.

    While a text waits to be made, peers that ask later share it, so that only one of each key waits.
    """

    def __init__(self) -> None:
        self._newest: dict[str, tuple[bytes, JsonPayload, float]] = {}
        """The message, its text, and when somebody first asked for it."""

    def of(self, key: str, message: bytes) -> tuple[bytes, JsonPayload]:
        """Return the text of ``message``, or of the one before it, together with its message.

        Raises QueryError if the message is too long.
        """
        if key in self._newest:
            newest, payload, asked_s = self._newest[key]
            is_waiting = not payload.is_made and time.monotonic() - asked_s < _UNMADE_S
            if newest == message or is_waiting:
                return newest, payload
        if len(message) > MAX_JSON_SOURCE_BYTES:
            raise QueryError(
                f"a frame of {len(message)} bytes is too long for JSON; ask without format=json",
                code="refused",
            )
        payload = JsonPayload(lambda: json_text(decode(message)).encode(), JSON_RATIO * len(message))
        self._newest[key] = message, payload, time.monotonic()
        return message, payload
