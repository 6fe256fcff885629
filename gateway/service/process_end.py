"""The end of the process: in time, and without Python's own shutdown.

docs/design.md explains why Python's shutdown is avoided.
"""

import asyncio
import atexit
import logging
import os
import queue
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from types import FrameType
from typing import Final, NoReturn

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


class StopDeadline:
    """Ends the process STOP_S after the first call of ``begin``, or at the second call.

    The exit status is 0, because the end was requested: systemd does not count it as a failure. What is not
    finished then is logged; ``unfinished`` returns it. This runs in a thread, because the event loop may be
    what does not finish.
    """

    def __init__(self, unfinished: Callable[[], Sequence[str]]) -> None:
        self._unfinished = unfinished
        self._calls: queue.SimpleQueue[None] = queue.SimpleQueue()
        threading.Thread(target=self._run, name="stop-deadline", daemon=True).start()

    def begin(self) -> None:
        """Begin to count. This may be called in a signal handler."""
        self._calls.put(None)  # SimpleQueue is reentrant, unlike most of threading

    def _run(self) -> None:
        self._calls.get()
        reason = f"it did not stop within {STOP_S:g} s"
        with suppress(queue.Empty):
            self._calls.get(timeout=STOP_S)
            reason = "of a second signal"
        message = threading.Thread(target=self._log, args=(reason,), name="stop-log", daemon=True)
        message.start()
        message.join(_LOG_S)
        os._exit(0)

    def _log(self, reason: str) -> None:
        logger.warning(
            "the gateway ends at once, because %s; not finished: %s",
            *(reason, ", ".join(self._unfinished()) or "other tasks"),
        )


def named_tasks(loop: asyncio.AbstractEventLoop) -> list[str]:
    """Return the names of the tasks that have one and are not done. It may be called in any thread."""
    names = {task.get_name() for task in asyncio.all_tasks(loop)}
    return sorted(name for name in names if not name.startswith("Task-"))
