"""When a session reads from its server: in turns with the other sources, and when it has caught up."""

import asyncio
from collections.abc import Callable
from typing import Final

LONG_READ_BYTES: Final = 64 * 1024
"""After a read of this size, other sources have their turn. The event loop reads up to 256 KB at once. If a
connection fills that, the loop reads from it up to 32 times before it looks at another one."""


class Reading:
    """Reads from one server only when what has arrived is processed, and no backlog waits.

    ``process`` takes further bytes, here always b"", and when the read arrived (see HostClock.read). It works
    for a limited time. While it returns True, it is called again when the other sources had their turn. It
    must not raise.
    """

    def __init__(self, process: Callable[[bytes, int, int], bool]) -> None:
        self._process = process
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport | None = None
        self._has_backlog = False
        self._waits_for_turn = False
        self._is_called_soon = False
        self._arrival = (0, 0)  # of what waits for its turn
        self._is_paused = False

    @property
    def is_idle(self) -> bool:
        """Whether everything that arrived has been processed."""
        return not self._waits_for_turn

    def begin(self, transport: asyncio.Transport) -> None:
        """Read from this connection."""
        self._transport = transport
        self._pause_or_resume()  # data may have arrived already

    def set_backlog(self, has_backlog: bool) -> None:
        """Read and process nothing while a backlog waits."""
        self._has_backlog = has_backlog
        if self._waits_for_turn:
            self._continue_soon()
        self._pause_or_resume()

    def wait_for_turn(self, utime: int, steady_us: int) -> None:
        """Let the other sources have their turn, then process what remains of a read, and read on."""
        self._arrival = (utime, steady_us)
        self._waits_for_turn = True
        self._continue_soon()
        self._pause_or_resume()

    def _continue_soon(self) -> None:
        if not self._has_backlog and not self._is_called_soon:
            self._is_called_soon = True
            self._loop.call_soon(self._continue)

    def _continue(self) -> None:
        self._is_called_soon = False
        if self._has_backlog:
            return  # set_backlog calls again
        self._waits_for_turn = False
        utime, steady_us = self._arrival
        if self._process(b"", utime, steady_us):
            self.wait_for_turn(utime, steady_us)
        self._pause_or_resume()

    def _pause_or_resume(self) -> None:
        transport = self._transport
        is_paused = self._has_backlog or self._waits_for_turn
        if transport is None or transport.is_closing() or self._is_paused is is_paused:
            return
        self._is_paused = is_paused
        if is_paused:
            transport.pause_reading()
        else:
            transport.resume_reading()
