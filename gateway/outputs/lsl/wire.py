"""The messages between the gateway and its process for LSL, over a pair of connected sockets.

To the process: a header (kind, number of the stream, bytes that follow) and content. From the process: lines
of JSON, see ``Report``.
"""

import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

HEADER: Final = struct.Struct("<BII")
_COUNT: Final = struct.Struct("<I")


class Kind(IntEnum):
    """The kind of a message to the process."""

    OPEN = 1
    """Open a stream; the content is JSON: its facts, and its tree as [name, text or children]."""
    CLOSE = 2
    """Close a stream; no content."""
    SAMPLES = 3
    """Push samples: their number, their times (float64), their values (float32)."""
    TEXTS = 4
    """Push samples of one text each; the content is JSON: a list of times and one of texts."""


class Message(NamedTuple):
    """A message to the process. Times are on the system's monotonic clock, in s."""

    kind: Kind
    stream: int
    content: bytes = b""

    def encode(self) -> bytes:
        """Return the bytes to send."""
        return HEADER.pack(self.kind, self.stream, len(self.content)) + self.content


REPORT_INTERVAL_S: Final = 1.0
"""The process repeats its report this often, even if nothing has changed, to show that it does not hang."""


class Report(NamedTuple):
    """What the process reports. ``wanted`` are the numbers of the streams that somebody receives.

    ``ready`` is the version of liblsl, "" while it is not loaded. ``not_opened`` is a stream that liblsl
    cannot open, and why. ``failure`` says why the process ends.
    """

    ready: str = ""
    wanted: tuple[int, ...] = ()
    not_opened: str = ""
    failure: str = ""

    def encode(self) -> bytes:
        """Return one line of JSON."""
        return json.dumps(self._asdict()).encode() + b"\n"

    @classmethod
    def decode(cls, line: bytes) -> "Report":
        """Return the report of one line."""
        fields = json.loads(line)
        return cls(**{**fields, "wanted": tuple(fields["wanted"])})


def samples_content(times_s: Sequence[float], values: npt.NDArray[np.float32]) -> bytes:
    """Return the content of SAMPLES; ``values`` has the shape (samples, channels)."""
    times = np.asarray(times_s, "<f8").tobytes()
    return _COUNT.pack(len(times_s)) + times + values.astype("<f4", copy=False).tobytes()


def decode_samples(content: bytes) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float32]]:
    """Return the times and the values, shape (samples, channels)."""
    (count,) = _COUNT.unpack_from(content)
    times = np.frombuffer(content, "<f8", count, _COUNT.size)
    values = np.frombuffer(content, "<f4", -1, _COUNT.size + times.nbytes)
    return times, values.reshape(count, -1)


def json_content(value: Any) -> bytes:
    """Return the content of TEXTS."""
    return json.dumps(value).encode()


def opening_content(facts: Mapping[str, Any], tree: Sequence[Any]) -> bytes:
    """Return the content of OPEN."""
    return f"[{json.dumps(facts)}, [{', '.join(map(_tree_json, tree))}]]".encode()


def _tree_json(element: tuple[str, Any]) -> str:
    # One call of json.dumps for thousands of channels would keep all other threads waiting.
    name, content = element
    if isinstance(content, str):
        return json.dumps(element)
    return f'["{name}", [{", ".join(map(_tree_json, content))}]]'


class MessageReader:
    """Cuts the bytes that the process receives into messages."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[Message]:
        """Return the messages that are complete with ``data``."""
        self._buffer += data
        start = 0
        while len(self._buffer) - start >= HEADER.size:
            kind, stream, size = HEADER.unpack_from(self._buffer, start)
            end = start + HEADER.size + size
            if end > len(self._buffer):
                break
            yield Message(Kind(kind), stream, bytes(self._buffer[start + HEADER.size : end]))
            start = end
        del self._buffer[:start]
