"""A clock and time-outs that count only the time during which this process runs.

While the process is stopped (SIGSTOP, a busy host, a suspended virtual machine), what peers send waits in
the sockets. When the process continues, the event loop calls its timers before it reads the sockets. So
with ordinary time-outs every stop would look like a peer that does not answer.
"""

import asyncio
import threading
from collections import deque
from types import TracebackType
from typing import Final

_TICK_S: Final = 0.1
_MAX_STEP_S: Final = 0.2
"""How much a stop counts, however long it is. A loop whose timers are at most 0.1 s late loses no time."""

_DELAY_S: Final = 0.05
"""Delays of this length and more are kept: with less, no buffer between server and gateway is full."""

_DELAY_WINDOW_S: Final = 30.0
"""How long a delay is kept. What waited meanwhile is read by then: at twice its rate, or faster."""


class RunningClock:
    """The seconds during which an event loop has run. It stands still while the process is stopped.

    Ticks show that the loop runs. Callbacks that run often anyway call ``tick``, because a timer that wakes
    the process costs as much as a frame; the timer ticks if nobody has done so for ``_TICK_S``.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.loop = loop
        self._loop_time = loop.time  # saves looking it up for every read
        self._time_s = 0.0  # at the newest tick
        self._tick_s = loop.time()
        self._delays_s: deque[tuple[float, float]] = deque(maxlen=round(_DELAY_WINDOW_S / _TICK_S))
        self._timer: asyncio.Handle = loop.call_later(_TICK_S, self._tick)

    def time(self) -> float:
        """Return the seconds since the clock was made, without those during which the process was stopped."""
        since_tick_s = self._loop_time() - self._tick_s
        return self._time_s + min(_MAX_STEP_S, since_tick_s)

    def tick(self) -> float:
        """Return what ``time`` returns; if the timer is due soon, tick now and save its wake-up."""
        since_tick_s = self._loop_time() - self._tick_s
        if since_tick_s < _TICK_S / 2:
            return self._time_s + since_tick_s
        self._timer.cancel()
        self._tick()
        return self._time_s

    def longest_delay_s(self, window_s: float = _DELAY_WINDOW_S) -> float:
        """Return the longest time in the last ``window_s`` for which the loop did not run, or 0.

        Nobody read meanwhile. The window is 30 s at most.
        """
        now_s = self._loop_time()
        recent = [delay_s for time_s, delay_s in self._delays_s if now_s - time_s < window_s]
        present_s = now_s - self._tick_s - _TICK_S
        return max([*recent, present_s if present_s >= _DELAY_S else 0.0])

    def _tick(self) -> None:
        self._time_s = self.time()
        now_s = self._loop_time()
        if now_s - self._tick_s - _TICK_S >= _DELAY_S:
            self._delays_s.append((now_s, now_s - self._tick_s - _TICK_S))
        self._tick_s = now_s
        self._timer = self.loop.call_later(_TICK_S, self._tick)


_clocks: Final = threading.local()  # its attribute ``clock`` is the newest one of the thread


def running_clock() -> RunningClock:
    """Return the clock of the running event loop; there is one per loop."""
    loop = asyncio.get_running_loop()
    clock: RunningClock | None = getattr(_clocks, "clock", None)
    if clock is None or clock.loop is not loop:
        clock = RunningClock(loop)
        _clocks.clock = clock
    return clock


_MIN_WAIT_S: Final = 0.001  # uvloop's timers have whole milliseconds; shorter ones would be called at once


class RunningTimeout:
    """A context like ``asyncio.timeout`` that counts only the time during which the process runs.

    Before the time-out ends, the event loop reads what has arrived on the sockets.
    """

    def __init__(self, seconds: float) -> None:
        self._clock = running_clock()
        self._end_s = self._clock.time() + seconds
        self._limit = asyncio.timeout(None)
        self._handle: asyncio.Handle | None = None

    async def __aenter__(self) -> None:
        await self._limit.__aenter__()
        self._wait()

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._handle is not None:
            self._handle.cancel()
        await self._limit.__aexit__(kind, error, trace)

    def _wait(self) -> None:
        left_s = self._end_s - self._clock.time()
        if left_s > 0:
            self._handle = self._clock.loop.call_later(max(left_s, _MIN_WAIT_S), self._wait)
        else:
            self._handle = self._clock.loop.call_soon(self._read_first)

    def _read_first(self) -> None:
        # The next turn of the loop begins with the sockets.
        self._handle = self._clock.loop.call_soon(lambda: self._limit.reschedule(self._clock.loop.time()))
