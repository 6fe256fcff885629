"""What may stop the whole process: no further threads or open files, memory, a late event loop."""

import asyncio
import contextlib
import ctypes
import errno
import logging
import os
import resource
import threading
import time
from pathlib import Path
from typing import Final

from gateway.errors import FILES_ADVICE, NO_FILES
from gateway.logs.failures import HOLD_S, FailureLog
from gateway.stream.process_clock import RunningClock, running_clock
from gateway.workers import thread_starts

MAX_FILES: Final = 65_536
"""How many files the gateway wants to open at most: more than the clients that its outputs accept."""

_MAX_ARENAS: Final = 2
_M_ARENA_MAX: Final = -8
"""The parameter of mallopt(3) that limits the number of arenas."""

logger = logging.getLogger(__name__)


def raise_file_limit() -> None:
    """Let the process open as many files as the system allows it, at most MAX_FILES.

    The limit that programs start with is usually 1024, for the sake of programs that use select().
    """
    with contextlib.suppress(OSError, ValueError):  # a sandbox may forbid it
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        wanted = MAX_FILES if hard == resource.RLIM_INFINITY else min(hard, MAX_FILES)
        if soft != resource.RLIM_INFINITY and soft < wanted:
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def limit_arenas() -> None:
    """Let the threads of the process share two of malloc's arenas, so that they reuse each other's memory.

    glibc gives the threads up to eight arenas per core, and returns little of what they free: floods of
    queries and hundreds of reloads left up to three times the memory behind. Call it before Zenoh starts.
    """
    with contextlib.suppress(AttributeError):  # another libc, which has no arenas
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, _MAX_ARENAS)


def return_free_memory() -> None:
    """Return to the system what glibc keeps of freed memory. Call it in a thread, for it may take 0.3 s.

    glibc keeps what is free between blocks in use: 215 of its 250 MiB after an hour of attacks. Threads that
    allocate meanwhile waited for up to 0.07 s to return 300 MiB on a busy machine.
    """
    with contextlib.suppress(AttributeError):  # another libc
        ctypes.CDLL(None).malloc_trim(0)


class ProcessLimits:
    """Finds out what the system refuses now, and logs when that begins and ends."""

    def __init__(self) -> None:
        self._files = FailureLog(logger, "gateway", HOLD_S)
        self._threads = FailureLog(logger, "gateway", HOLD_S)

    def problems(self) -> list[str]:
        """Return what the system refuses now, and what to do. Call it once a second, or more often."""
        problems = []
        for failures, problem, recovery in (
            (self._files, _file_problem(), "files can be opened again"),
            (self._threads, _thread_problem(), "threads can be started again"),
        ):
            if problem:
                failures.failed(problem)
                problems.append(problem)
            else:
                failures.recovered(recovery)
        return problems


def _file_problem() -> str:
    most = ""
    try:
        os.close(os.open(os.devnull, os.O_RDONLY))
    except OSError as error:
        if error.errno == errno.ENFILE:
            return (
                "the computer has no file descriptor left, so nobody can connect, and no file can be opened; "
                "end programs that have many files open, or raise fs.file-max"
            )
        if error.errno in NO_FILES:
            with contextlib.suppress(OSError):  # a sandbox may forbid it
                most = f" {resource.getrlimit(resource.RLIMIT_NOFILE)[0]}"
            return (
                f"all{most} file descriptors of the gateway are in use, so nobody can connect, and no file "
                f"can be opened; {FILES_ADVICE}"
            )
    return ""


def _thread_problem() -> str:
    thread_starts.check()
    if not thread_starts.is_failing:
        return ""
    return (
        f"no further thread can be started beside the {_num_threads()} of the gateway "
        f"({thread_starts.num_failed} attempts failed), so parts of it do not work; end other programs of "
        "its user, or let it have more (TasksMax of the service)"
    )


def _num_threads() -> int:
    try:
        return sum(1 for _ in Path("/proc/self/task").iterdir())
    except OSError:
        return threading.active_count()


class ReservedFiles:
    """File descriptors that are kept for when none is left.

    ``use`` frees one, and whatever opens a file next gets it. ``refill`` takes back what is free again.
    """

    def __init__(self, number: int) -> None:
        self._number = number
        self._reserved: list[int] = []

    def use(self) -> bool:
        """Free one; return False if none is left."""
        if not self._reserved:
            return False
        os.close(self._reserved.pop())
        return True

    def refill(self) -> None:
        """Reserve as many as are missing, if the system allows it."""
        with contextlib.suppress(OSError):
            while len(self._reserved) < self._number:
                self._reserved.append(os.open(os.devnull, os.O_RDONLY))

    def close(self) -> None:
        """Free all."""
        while self.use():
            pass


_PERIOD_S: Final = 1.0
"""Each measurement wakes the process, which costs as much CPU time as a frame."""

_WINDOW_S: Final = 60.0


class LoopDelay:
    """Measures every second how late a timer fires, and takes over longer delays from the running clock.

    Call ``start`` in the running event loop.
    """

    def __init__(self) -> None:
        self.last_s = 0.0
        """The delay of the newest measurement."""
        self._max_s = self._previous_max_s = 0.0  # of this minute and of the one before
        self._window_end_s = self._due_s = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._running: RunningClock | None = None  # set by ``start``

    @property
    def max_s(self) -> float:
        """The largest delay of the last one to two minutes, so a scrape each minute misses none."""
        return max(self._max_s, self._previous_max_s)

    def start(self) -> None:
        """Start measuring."""
        self._running = running_clock()
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
        if self._running is not None:
            self._max_s = max(self._max_s, self._running.longest_delay_s(2 * _PERIOD_S))
        self._schedule()
