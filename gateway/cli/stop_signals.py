"""Stopping a command by signals: in order at the first one, at once at the second one."""

import signal
import threading
from collections.abc import Callable
from types import FrameType


def stop_at_signals(end_at_once: Callable[[int], object]) -> threading.Event:
    """Return an event that the first Ctrl-C, SIGTERM or SIGHUP sets.

    The second one calls ``end_at_once`` with its number, which ends the process.
    """
    stop = threading.Event()

    def handle(number: int, _frame: FrameType | None) -> None:
        if stop.is_set():
            end_at_once(number)
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:  # nohup, and shells for `&`
            signal.signal(number, handle)
    return stop
