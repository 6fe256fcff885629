"""Stopping a command by signals: in order at the first one, at once at the second one."""

import os
import select
import signal
from collections.abc import Callable
from types import FrameType


class StopSignals:
    """Waits for Ctrl-C, SIGTERM or SIGHUP; the second one calls ``end_at_once``, which ends the process.

    A threading.Event cannot be set in a signal handler: the handler may interrupt its ``wait`` while that
    holds the lock that ``set`` needs. A pipe has no lock. Create it in the main thread.
    """

    def __init__(self, end_at_once: Callable[[int], object]) -> None:
        self._end_at_once = end_at_once
        self._is_set = False
        self._reading, self._writing = os.pipe()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:  # nohup, and shells for `&`
                signal.signal(number, self._handle)

    def wait(self, timeout_s: float) -> bool:
        """Wait for the first signal; return whether it has come."""
        return bool(select.select([self._reading], [], [], timeout_s)[0])

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        if self._is_set:
            self._end_at_once(number)
        self._is_set = True
        os.write(self._writing, b"\0")
