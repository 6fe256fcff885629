"""Calls that may take long or block: a thread for them, and processes that run a module of this package."""

import asyncio
import contextlib
import errno
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from typing import Any, Final, TypeVar

_IDLE_S: Final = 1.0
"""The thread ends when it has had nothing to do for this long. The next call starts another one."""

_Result = TypeVar("_Result")


class ThreadStarts:
    """Whether the system lets the process start threads."""

    def __init__(self) -> None:
        self.num_failed = 0
        """How many threads could not be started since the process began."""
        self.is_failing = False
        """Whether that is so now, as far as is known."""

    def start(self, thread: threading.Thread) -> None:
        """Start a thread. Raises RuntimeError if the system does not allow it."""
        try:
            thread.start()
        except RuntimeError:
            self.num_failed += 1
            self.is_failing = True
            raise
        self.is_failing = False

    def check(self) -> None:
        """If the last start failed, try again with a thread that does nothing."""
        if self.is_failing:
            with contextlib.suppress(RuntimeError):
                self.start(threading.Thread(target=lambda: None, name="test", daemon=True))


thread_starts: Final = ThreadStarts()
"""The threads of this process start here, so that its health can say when one could not."""


class WorkerThread:
    """Makes calls one after the other in its own thread, which exists only while there are calls.

    A concurrent.futures.ThreadPoolExecutor does not fit: Python waits for its threads at exit, so a disk that
    does not respond would delay the end of the gateway. The queue is not bounded: the caller has to know how
    much it submits.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._calls: deque[tuple[Future[Any], Callable[[], Any]]] = deque()
        self._changed = threading.Condition()
        self._is_running = False
        self._began_s: float | None = None  # the present call, on the monotonic clock

    def submit(self, call: Callable[[], _Result]) -> Future[_Result]:
        """Queue ``call``; the returned future has its result or exception. It can be cancelled before.

        The exception is an OSError if no thread can be started.
        """
        done: Future[_Result] = Future()
        with self._changed:
            self._calls.append((done, call))
            if self._is_running:
                self._changed.notify()
            else:
                self._start()
        return done

    def _start(self) -> None:
        try:
            thread_starts.start(threading.Thread(target=self._run, name=self._name, daemon=True))
            self._is_running = True
        except RuntimeError as error:
            done, _ = self._calls.pop()
            done.set_exception(OSError(errno.EAGAIN, str(error)))

    async def run(self, call: Callable[[], _Result]) -> _Result:
        """Return the result of ``call``, or raise its exception."""
        return await asyncio.wrap_future(self.submit(call))

    @property
    def call_age_s(self) -> float:
        """How long the present call takes already; 0.0 if there is none."""
        began_s = self._began_s
        return 0.0 if began_s is None else time.monotonic() - began_s

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._calls), _IDLE_S)
                if not self._calls:
                    self._is_running = False
                    return
                done, call = self._calls.popleft()
            self._began_s = time.monotonic()
            make_call(done, call)
            self._began_s = None
            del done, call  # or they would stay in memory until the next call


async def result_of(call: Future[_Result]) -> _Result:
    """Return the result of a call, or raise its exception. Cancelling this does not cancel the call.

    What the call raises after that is not logged.
    """
    result = asyncio.wrap_future(call)
    result.add_done_callback(_retrieve)
    return await asyncio.shield(result)


def _retrieve(result: "asyncio.Future[Any]") -> None:
    if not result.cancelled():
        result.exception()  # otherwise, asyncio logs that it was never retrieved


def make_call(done: Future[_Result], call: Callable[[], _Result]) -> None:
    """Make ``call`` unless ``done`` has been cancelled, and set its result or exception in ``done``."""
    with contextlib.suppress(CancelledError):
        if done.set_running_or_notify_cancel():
            try:
                done.set_result(call())
            except BaseException as error:  # noqa: BLE001 - the future passes it on
                done.set_exception(error)
    del done, call  # or the traceback of the exception would keep them in memory


def module_environment() -> dict[str, str]:
    """Return the environment for a process that is to find the same modules as this one.

    Python would look for them in the working directory first, where somebody may have a pylsl.py.
    """
    return {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "PYTHONSAFEPATH": "1"}
