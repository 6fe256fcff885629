"""How late the event loop runs callbacks. Received frames wait just as long."""

import asyncio
import time
from typing import Final

_PERIOD_S: Final = 0.1
_WINDOW_S: Final = 60.0


class LoopDelay:
    """Measures every 0.1 s how late a timer fires. Call ``start`` in the running event loop."""

    def __init__(self) -> None:
        self.last_s = 0.0
        """The delay of the newest measurement."""
        self._max_s = self._previous_max_s = 0.0  # of this minute and of the one before
        self._window_end_s = self._due_s = 0.0
        self._timer: asyncio.TimerHandle | None = None

    @property
    def max_s(self) -> float:
        """The largest delay of the last one to two minutes, so a scrape each minute misses none."""
        return max(self._max_s, self._previous_max_s)

    def start(self) -> None:
        """Start measuring."""
        self._window_end_s = time.monotonic() + _WINDOW_S
        self._schedule()

    def close(self) -> None:
        """Stop measuring."""
        if self._timer is not None:
            self._timer.cancel()

    def record(self, now_s: float, delay_s: float) -> None:
        """Add one measurement, made at ``now_s`` on the monotonic clock."""
        self.last_s = delay_s
        if now_s >= self._window_end_s:
            self._previous_max_s, self._max_s = self._max_s, 0.0
            self._window_end_s = now_s + _WINDOW_S
        self._max_s = max(self._max_s, delay_s)

    def _schedule(self) -> None:
        # time.monotonic, because uvloop's own clock counts whole milliseconds
        self._due_s = time.monotonic() + _PERIOD_S
        self._timer = asyncio.get_running_loop().call_later(_PERIOD_S, self._measure)

    def _measure(self) -> None:
        now_s = time.monotonic()
        self.record(now_s, max(0.0, now_s - self._due_s))  # uvloop's timers may be up to 1 ms early
        self._schedule()
