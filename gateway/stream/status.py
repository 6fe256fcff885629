"""The status of one stream: its state, its counters and what went wrong."""

import logging
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from gateway.messages.host_time import now_utime
from gateway.stream.clock import ServerClock
from gateway.stream.state import StreamInput, StreamState, next_state

MAX_ERROR_LENGTH: Final = 500
"""What is kept of an error's text: it may quote a server, and goes out with every status message."""


MAX_LIMITATIONS: Final = 20
"""How many are kept of one connection, and how many of those told last are known as told."""

_TRYING: Final = (StreamState.CONNECTING, StreamState.HANDSHAKING, StreamState.WAITING)

logger = logging.getLogger(__name__)


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
