"""How long the event loop keeps what is due waiting, every frame included."""

import asyncio
import time
from typing import Final

_PERIOD_S: Final = 0.1
_WINDOW_S: Final = 60.0


class LoopDelay:
    """Asks the loop to call back every 0.1 s and notes how late it does; ``start`` it in the loop."""

    def __init__(self) -> None:
        self.last_s = 0.0
        """By how much the last call was late."""
        self._max_s = self._max_before_s = 0.0  # of this window and of the one before
        self._window_end_s = self._due_s = 0.0
        self._timer: asyncio.TimerHandle | None = None

    @property
    def max_s(self) -> float:
        """The largest delay of the last one to two minutes: scrapes less than a minute apart miss none."""
        return max(self._max_s, self._max_before_s)

    def start(self) -> None:
        """Begin to measure."""
        self._window_end_s = time.monotonic() + _WINDOW_S
        self._call()

    def close(self) -> None:
        """Stop measuring."""
        if self._timer is not None:
            self._timer.cancel()

    def note(self, now_s: float, delay_s: float) -> None:
        """Take one delay, found at ``now_s`` of the monotonic clock."""
        self.last_s = delay_s
        if now_s >= self._window_end_s:
            self._max_before_s, self._max_s = self._max_s, 0.0
            self._window_end_s = now_s + _WINDOW_S
        self._max_s = max(self._max_s, delay_s)

    def _call(self) -> None:
        # Not the loop's own time, which uvloop keeps in whole milliseconds.
        self._due_s = time.monotonic() + _PERIOD_S
        self._timer = asyncio.get_running_loop().call_later(_PERIOD_S, self._called)

    def _called(self) -> None:
        now_s = time.monotonic()
        self.note(now_s, max(0.0, now_s - self._due_s))  # uvloop's timers may be up to 1 ms early
        self._call()
