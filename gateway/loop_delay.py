"""How long the event loop keeps what is due waiting, every frame included."""

import asyncio
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
        loop = asyncio.get_running_loop()
        self._window_end_s = loop.time() + _WINDOW_S
        self._call(loop)

    def close(self) -> None:
        """Stop measuring."""
        if self._timer is not None:
            self._timer.cancel()

    def note(self, now_s: float, delay_s: float) -> None:
        """Take one delay, found at the loop's time ``now_s``."""
        self.last_s = delay_s
        if now_s >= self._window_end_s:
            self._max_before_s, self._max_s = self._max_s, 0.0
            self._window_end_s = now_s + _WINDOW_S
        self._max_s = max(self._max_s, delay_s)

    def _call(self, loop: asyncio.AbstractEventLoop) -> None:
        self._due_s = loop.time() + _PERIOD_S
        self._timer = loop.call_at(self._due_s, self._called, loop)

    def _called(self, loop: asyncio.AbstractEventLoop) -> None:
        now_s = loop.time()
        self.note(now_s, max(0.0, now_s - self._due_s))
        self._call(loop)
