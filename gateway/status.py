"""Counters of streams and outputs, and the status message made of them."""

import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

import rtc3d

from gateway import __version__

MAX_ERROR_LENGTH: Final = 500
"""What is kept of an error's text: it may quote a server, and goes out with every status message."""


def now_utime() -> int:
    """Return the host's time in µs since the Unix epoch."""
    return time.time_ns() // 1000


@dataclass(slots=True)
class StreamStatus:
    """How one stream is; the supervisor and the fan-out keep it up to date, the status reads it.

    ``components`` is as configured, space-separated. ``drops`` counts what came and was not
    published, by cause. ``limitations`` says what the present connection does without.
    """

    components: str
    state: str = "connecting"
    byte_order: str = ""
    rate: str = ""
    session: int = 0
    frames_in: int = 0
    bytes_in: int = 0
    reconnects: int = 0
    drops: Counter[str] = field(default_factory=Counter)
    limitations: list[str] = field(default_factory=list)
    last_error: str = ""
    last_error_utime: int = 0

    def note_error(self, text: str) -> None:
        """Keep ``text``, at most MAX_ERROR_LENGTH of it, as the last error, with the time."""
        self.last_error = text[:MAX_ERROR_LENGTH]
        self.last_error_utime = now_utime()


@dataclass(slots=True)
class OutputStatus:
    """What one output did for one source: messages by component, and drops by cause."""

    name: str
    messages: Counter[str] = field(default_factory=Counter)
    drops: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True, slots=True)
class OutputHealth:
    """Whether an output can send, and if not, what is wrong and what to do."""

    connected: bool
    problem: str = ""


class FrameRate:
    """Frames per second between one call and the next."""

    def __init__(self) -> None:
        self._frames = 0
        self._time_s = time.monotonic()

    def update(self, frames: int) -> float:
        """Return the mean rate since the last call, in Hz, given the count of frames so far."""
        now_s = time.monotonic()
        elapsed_s = now_s - self._time_s
        rate_hz = (frames - self._frames) / elapsed_s if elapsed_s > 0 else 0.0
        self._frames, self._time_s = frames, now_s
        return rate_hz


def status_message(
    *,
    source: str,
    server: str,
    sequence: int,
    streams: Sequence[tuple[StreamStatus, float]],
    outputs: Iterable[tuple[OutputStatus, OutputHealth]],
) -> rtc3d.status_t:
    """Return the status of one source as its LCM message; ``streams`` come with their rates in Hz."""
    message = rtc3d.status_t()
    message.utime = message.capture_utime = now_utime()
    message.sequence = sequence
    message.session = sum(stream.session for stream, _ in streams)
    message.source = source
    message.server = server
    message.gateway_version = __version__
    message.streams = [_stream_message(stream, rate_hz) for stream, rate_hz in streams]
    message.num_streams = len(message.streams)
    message.outputs = [_output_message(output, health) for output, health in outputs]
    message.num_outputs = len(message.outputs)
    return message


def _stream_message(stream: StreamStatus, rate_hz: float) -> rtc3d.stream_status_t:
    message = rtc3d.stream_status_t()
    for name in (
        "components",
        "state",
        "byte_order",
        "rate",
        "session",
        "frames_in",
        "bytes_in",
        "reconnects",
        "last_error",
        "last_error_utime",
    ):
        setattr(message, name, getattr(stream, name))
    message.frame_rate_hz = rate_hz
    message.drops = _counts(stream.drops)
    message.num_drops = len(message.drops)
    message.limitations = list(stream.limitations)
    message.num_limitations = len(message.limitations)
    return message


def _output_message(output: OutputStatus, health: OutputHealth) -> rtc3d.output_status_t:
    message = rtc3d.output_status_t()
    message.name = output.name
    message.connected = health.connected
    message.problem = health.problem
    message.messages = _counts(output.messages)
    message.num_messages = len(message.messages)
    message.drops = _counts(output.drops)
    message.num_drops = len(message.drops)
    return message


def _counts(counter: Counter[str]) -> list[rtc3d.count_t]:
    messages = []
    for name, count in sorted(counter.items()):
        message = rtc3d.count_t()
        message.name = name
        message.count = count
        messages.append(message)
    return messages
