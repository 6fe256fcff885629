"""Counters of streams and outputs, and the status message made of them."""

import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

import rtc3d

from gateway import __version__
from gateway.stream.clock import ServerClock
from gateway.stream.state import StreamInput, StreamState, next_state

MAX_ERROR_LENGTH: Final = 500
"""What is kept of an error's text: it may quote a server, and goes out with every status message."""


MAX_LIMITATIONS: Final = 20
"""How many are kept of one connection, and how many of those told last are known as told."""

_TRYING: Final = (StreamState.CONNECTING, StreamState.HANDSHAKING, StreamState.WAITING)

_time_ns: Final = time.time_ns  # compiled, a Final is not looked up by its name at every call

logger = logging.getLogger(__name__)


def now_utime() -> int:
    """Return the host's time in µs since the Unix epoch."""
    return _time_ns() // 1000


@dataclass
class StreamStatus:
    """How one stream is; the session and the intake keep it up to date, the status reads it.

    ``name`` begins its log lines; ``on_state`` is called with each new state.
    ``components`` is as configured, space-separated. ``drops`` counts what came and was not
    published, by cause. ``limitations`` says what the present connection does without.
    ``last_frame_utime`` is when the newest frame came, µs since the Unix epoch, 0 before the first.
    ``tries`` counts the tries to connect since the last that ended in a handshake.
    """

    components: str
    name: str = ""
    on_state: Callable[[StreamState], None] = lambda _state: None
    state: StreamState = StreamState.WAITING
    byte_order: str = ""
    rate: str = ""
    session: int = 0
    frames_in: int = 0
    last_frame_utime: int = 0
    bytes_in: int = 0
    tries: int = 0
    reconnects: int = 0
    restarts: int = 0
    lag_s: float = 0.0
    clock: ServerClock = field(default_factory=ServerClock)
    drops: Counter[str] = field(default_factory=Counter)
    limitations: list[str] = field(default_factory=list)
    last_error: str = ""
    last_error_utime: int = 0
    _told: deque[str] = field(default_factory=lambda: deque(maxlen=MAX_LIMITATIONS), init=False)

    def move(self, happened: StreamInput, cause: str) -> None:
        """Change the state as the table has it, log the change with its cause, and tell of it."""
        if happened is StreamInput.DIAL:
            self.tries += 1
        elif happened is StreamInput.READY:
            self.tries = 0
        before, self.state = self.state, next_state(self.state, happened)
        if self.state is before:
            return
        # While a server is away, the tries come and go: the supervisor tells of them as one failure.
        level = logging.DEBUG if self.state in _TRYING else logging.INFO
        logger.log(
            level, "%s: %s → %s: %s (%s)", self.name, before.value, self.state.value, happened.value, cause
        )
        self.on_state(self.state)

    def begin_session(self) -> None:
        """Count a new connection and forget what was agreed in the last one."""
        self.session += 1
        self.limitations.clear()
        self.byte_order = self.rate = ""

    def limit(self, text: str) -> bool:
        """Note what this connection does without; at most MAX_LIMITATIONS of them are kept.

        Returns whether it is news: not noted before, of an earlier connection neither.
        """
        if text in self.limitations or len(self.limitations) >= MAX_LIMITATIONS:
            return False
        self.limitations.append(text)
        if text in self._told:
            return False
        self._told.append(text)
        return True

    def note_error(self, text: str) -> None:
        """Keep ``text``, at most MAX_ERROR_LENGTH of it, as the last error, with the time."""
        self.last_error = text[:MAX_ERROR_LENGTH]
        self.last_error_utime = now_utime()


@dataclass
class OutputStatus:
    """What one output did for one source: messages and their bytes by component, and drops by cause."""

    name: str
    messages: Counter[str] = field(default_factory=Counter)
    drops: Counter[str] = field(default_factory=Counter)
    message_bytes: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True)
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


def clock_message(source_session: int, sequence: int, stream: StreamStatus) -> rtc3d.clock_t:
    """Return the clock of one stream as its LCM message."""
    message = rtc3d.clock_t()
    message.utime = message.capture_utime = now_utime()
    message.sequence = sequence
    message.session = source_session
    message.components = stream.components
    message.clock = clock_model(stream.clock)
    return message


def clock_model(clock: ServerClock) -> rtc3d.clock_model_t:
    """Return what is known of a server's clock as its LCM type."""
    model = rtc3d.clock_model_t()
    model.has_clock = clock.has_clock
    if clock.has_clock:
        model.offset_us = round(clock.offset_us)
        model.drift_ppm = clock.drift_ppm
        model.uncertainty_us = clock.uncertainty_us
    model.samples = clock.samples
    return model


def _stream_message(stream: StreamStatus, rate_hz: float) -> rtc3d.stream_status_t:
    message = rtc3d.stream_status_t()
    for name in (
        "components",
        "byte_order",
        "rate",
        "session",
        "frames_in",
        "bytes_in",
        "reconnects",
        "restarts",
        "last_error",
        "last_error_utime",
    ):
        setattr(message, name, getattr(stream, name))
    message.state = stream.state.value
    message.frame_rate_hz = rate_hz
    message.lag_ms = 1000 * stream.lag_s
    message.clock = clock_model(stream.clock)
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
