"""The end of the process: in time, and without Python's own shutdown.

docs/design.md explains why Python's shutdown is avoided.
"""

import atexit
import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from types import FrameType
from typing import TYPE_CHECKING, Final, NoReturn

if TYPE_CHECKING:
    import asyncio

STOP_S: Final = 1.5
"""How long an orderly stop may take. Systemd and users expect the end within 2 s."""

_LOG_S: Final = 0.2
"""How long the last message may take: the reader of the log may be what does not respond."""

logger = logging.getLogger(__name__)


def end_process(status: int) -> NoReturn:
    """Run the functions of atexit, flush stdout, stderr and the log, and end the process.

    Threads of Zenoh and LCM that return to Python during its own shutdown would abort the process (SIGABRT).
    """
    atexit._run_exitfuncs()  # noqa: SLF001 - there is no public name; logging flushes its handlers here
    try:
        sys.stdout.flush()
    except (BrokenPipeError, ValueError):
        pass  # nobody reads it any more, or it is closed
    except OSError as error:
        with suppress(OSError, ValueError):
            print(f"cannot write the output: {error.strerror}", file=sys.stderr)
        status = status or 1
    with suppress(OSError, ValueError):
        sys.stderr.flush()
    os._exit(status)


def end_at_once(_number: int, _frame: FrameType | None) -> NoReturn:
    """Handle a signal while nothing is open yet that would have to be closed."""
    os._exit(0)


class Signals:
    """Receives the signals of the process, also while the main thread is in a call that does not return.

    Python runs signal handlers only in the main thread, and so does the event loop. But Python writes the
    number of each signal to the wakeup descriptor at once, and a thread reads it here.

    SIGTERM and SIGINT call ``request_stop``. The process ends STOP_S after the first one, or at the second
    one. The exit status is then 0, because the end was requested: systemd does not count it as a failure.
    What is not finished is logged; ``unfinished`` returns it. SIGHUP calls ``hang_up``. All three are called
    in the thread. Create this object in the main thread, in the running event loop: the loop sets a wakeup
    descriptor of its own when it starts.
    """

    def __init__(
        self,
        request_stop: Callable[[], object],
        hang_up: Callable[[], object],
        unfinished: Callable[[], Sequence[str]],
    ) -> None:
        self._request_stop = request_stop
        self._hang_up = hang_up
        self._unfinished = unfinished
        self._numbers, self._written = socket.socketpair()
        self._written.setblocking(False)
        signal.set_wakeup_fd(self._written.fileno(), warn_on_full_buffer=False)
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, lambda *_: None)  # so that Python writes to the descriptor
        threading.Thread(target=self._run, name="signals", daemon=True).start()

    def _run(self) -> None:
        while self._next() == signal.SIGHUP:
            with suppress(Exception):  # the next signal may come when there is memory again
                self._hang_up()
        try:
            self._end()
        finally:  # whatever a process without memory, or without threads, raises
            os._exit(0)

    def _end(self) -> None:
        """Request the stop, and return when its time is over."""
        reason = f"it did not stop within {STOP_S:g} s"
        deadline_s = time.monotonic() + STOP_S
        with suppress(RuntimeError, MemoryError):  # the event loop has ended, or cannot be told
            self._request_stop()
        with suppress(TimeoutError):
            while self._next(max(0.001, deadline_s - time.monotonic())) == signal.SIGHUP:
                pass
            reason = "of a second signal"
        message = threading.Thread(target=self._log, args=(reason,), name="stop-log", daemon=True)
        message.start()
        message.join(_LOG_S)

    def _next(self, timeout_s: float | None = None) -> int:
        """Return the number of the next signal; raise TimeoutError if there is none in time."""
        self._numbers.settimeout(timeout_s)
        return self._numbers.recv(1)[0]

    def _log(self, reason: str) -> None:
        logger.warning(
            "the gateway ends at once, because %s; not finished: %s",
            *(reason, ", ".join(self._unfinished()) or "other tasks"),
        )


def named_tasks(loop: "asyncio.AbstractEventLoop") -> list[str]:
    """Return the names of the tasks that have one and are not done. It may be called in any thread."""
    import asyncio  # noqa: PLC0415 - every command ends with this module, and few need asyncio

    names = {task.get_name() for task in asyncio.all_tasks(loop)}
    return sorted(name for name in names if not name.startswith("Task-"))
