"""The time during which this process runs: what the silence of a peer is measured by.

While the process is stopped (SIGSTOP, a busy host, a suspended virtual machine), what peers send waits in
the sockets. When the process continues, the event loop calls its timers before it reads the sockets. So
with ordinary time-outs every stop would look like a peer that does not answer.
"""

import asyncio
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Final

_TICK_S: Final = 0.1
_MAX_STEP_S: Final = 0.2
"""How much a stop counts, however long it is. A loop whose timers are at most 0.1 s late loses no time."""

_MIN_WAIT_S: Final = 0.001  # uvloop's timers have whole milliseconds; shorter ones would be called at once


class RunningClock:
    """The seconds during which an event loop has run. It stands still while the process is stopped."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.loop = loop
        self._time_s = 0.0  # at the newest tick
        self._tick_s = loop.time()
        self._tick()

    def time(self) -> float:
        """Return the seconds since the clock was made, without those during which the process was stopped."""
        return self._time_s + min(self.loop.time() - self._tick_s, _MAX_STEP_S)

    def _tick(self) -> None:
        self._time_s = self.time()
        self._tick_s = self.loop.time()
        self.loop.call_later(_TICK_S, self._tick)


class _ThreadState(threading.local):
    clock: RunningClock | None = None


_thread = _ThreadState()


def running_clock() -> RunningClock:
    """Return the clock of the running event loop; there is one per loop."""
    loop = asyncio.get_running_loop()
    clock = _thread.clock
    if clock is None or clock.loop is not loop:
        clock = _thread.clock = RunningClock(loop)
    return clock


@asynccontextmanager
async def running_timeout(seconds: float) -> AsyncIterator[None]:
    """Do the same as ``asyncio.timeout``, but count only the time during which the process runs.

    Before the time-out ends, the event loop reads what has arrived on the sockets.
    """
    clock = running_clock()
    loop = clock.loop
    end_s = clock.time() + seconds
    async with asyncio.timeout(None) as limit:
        handle: asyncio.Handle

        def wait() -> None:
            nonlocal handle
            left_s = end_s - clock.time()
            if left_s > 0:
                handle = loop.call_later(max(left_s, _MIN_WAIT_S), wait)
            else:
                handle = loop.call_soon(read_first)

        def read_first() -> None:
            nonlocal handle
            handle = loop.call_soon(expire)  # in the next turn of the loop, which begins with the sockets

        def expire() -> None:
            limit.reschedule(loop.time())

        wait()
        try:
            yield
        finally:
            handle.cancel()
