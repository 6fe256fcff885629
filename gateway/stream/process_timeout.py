"""Time-outs that count only the time during which this process runs.

While the process is stopped (SIGSTOP, a busy host, a suspended virtual machine), what peers send waits in
the sockets. When the process continues, the event loop calls its timers before it reads the sockets. So
with ordinary time-outs every stop would look like a peer that does not answer.
"""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Final

from gateway.stream.process_clock import running_clock

_MIN_WAIT_S: Final = 0.001  # uvloop's timers have whole milliseconds; shorter ones would be called at once


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
