"""The clock of the time during which this process runs; running_time.py says what it is for."""

import asyncio
import threading
from typing import Final

_TICK_S: Final = 0.1
_MAX_STEP_S: Final = 0.2
"""How much a stop counts, however long it is. A loop whose timers are at most 0.1 s late loses no time."""


class RunningClock:
    """The seconds during which an event loop has run. It stands still while the process is stopped."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.loop = loop
        self._loop_time = loop.time  # saves looking it up for every read
        self._time_s = 0.0  # at the newest tick
        self._tick_s = loop.time()
        self._tick()

    def time(self) -> float:
        """Return the seconds since the clock was made, without those during which the process was stopped."""
        since_tick_s = self._loop_time() - self._tick_s
        return self._time_s + min(_MAX_STEP_S, since_tick_s)

    def _tick(self) -> None:
        self._time_s = self.time()
        self._tick_s = self._loop_time()
        self.loop.call_later(_TICK_S, self._tick)


_clocks: Final = threading.local()  # its attribute ``clock`` is the newest one of the thread


def running_clock() -> RunningClock:
    """Return the clock of the running event loop; there is one per loop."""
    loop = asyncio.get_running_loop()
    clock: RunningClock | None = getattr(_clocks, "clock", None)
    if clock is None or clock.loop is not loop:
        clock = RunningClock(loop)
        _clocks.clock = clock
    return clock
