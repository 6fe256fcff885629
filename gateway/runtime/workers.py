"""Calls that may take long or block: a thread for them, and processes that run a module of this package."""

import asyncio
import contextlib
import errno
import functools
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


MAX_CALLS: Final = 4096
MAX_BYTES: Final = 64 * 1024 * 1024
"""How many calls that may be given up wait for a thread, and how many bytes they hold."""


class QueueRoom:
    """The room of a queue, which has room for a call of any size when it is empty.

    The owner's lock protects it.
    """

    def __init__(self, max_calls: int = MAX_CALLS, max_bytes: int = MAX_BYTES) -> None:
        self.num_calls = 0
        """How many calls are in the queue."""
        self._num_bytes = 0  # that they hold
        self._max_calls = max_calls
        self._max_bytes = max_bytes

    def take(self, num_bytes: int) -> bool:
        """Take room for a call that holds ``num_bytes``; return False if there is not enough."""
        is_full = self.num_calls >= self._max_calls or self._num_bytes + num_bytes > self._max_bytes
        if is_full and self.num_calls:
            return False
        self.num_calls += 1
        self._num_bytes += num_bytes
        return True

    def free(self, num_bytes: int) -> None:
        """Free the room of a call."""
        self.num_calls -= 1
        self._num_bytes -= num_bytes


class WorkerThread:
    """Makes calls one after the other in its own thread, which exists only while there are calls.

    Unless it ``ends_when_idle``, the thread that the first call starts exists until the end.

    Two queues: calls that must be made (``submit``, ``run``) go first, and their callers bound them. Calls
    that may be given up (``offer``) are refused while too many wait, or too many bytes.

    A concurrent.futures.ThreadPoolExecutor does not fit: Python waits for its threads at exit, so a disk that
    does not respond, or a peer that does not read, would delay the end of the gateway.
    """

    def __init__(
        self,
        name: str,
        max_calls: int = MAX_CALLS,
        max_bytes: int = MAX_BYTES,
        *,
        ends_when_idle: bool = True,
    ) -> None:
        self._name = name
        self._ends_when_idle = ends_when_idle
        self._changed = threading.Condition()  # of everything below
        self._calls: deque[tuple[Future[Any], Callable[[], Any]]] = deque()
        self._offered: deque[tuple[int, Callable[[], None]]] = deque()
        self._room = QueueRoom(max_calls, max_bytes)
        self._is_running = False
        self._is_closed = False
        self._began_s: float | None = None  # the present call, on the monotonic clock

    def submit(self, call: Callable[[], _Result]) -> Future[_Result]:
        """Queue ``call``; the returned future has its result or exception. It can be cancelled before.

        The exception is an OSError if no thread can be started. After ``close``, the future is cancelled.
        """
        done: Future[_Result] = Future()
        with self._changed:
            if self._is_closed:
                done.cancel()
                return done
            self._calls.append((done, call))
            problem = self._wake()
            if problem is not None:
                self._calls.pop()
                done.set_exception(OSError(errno.EAGAIN, str(problem)))
        return done

    async def run(self, call: Callable[[], _Result]) -> _Result:
        """Return the result of ``call``, or raise its exception."""
        return await asyncio.wrap_future(self.submit(call))

    def offer(self, call: Callable[[], None], num_bytes: int = 0) -> bool:
        """Queue ``call``, which holds ``num_bytes``; return False if there is no room, or after ``close``.

        What ``call`` raises is reported as that of any thread, and the next call starts another one. If no
        thread can be started, it waits for the next call to start one.
        """
        with self._changed:
            if self._is_closed or not self._room.take(num_bytes):
                return False
            self._offered.append((num_bytes, call))
            self._wake()
        return True

    @property
    def call_age_s(self) -> float:
        """How long the present call takes already; 0.0 if there is none."""
        began_s = self._began_s
        return 0.0 if began_s is None else time.monotonic() - began_s

    def close(self, last: Callable[[], None] = lambda: None) -> None:
        """Make no further calls but ``last``; a call in progress continues."""
        with self._changed:
            if self._is_closed:
                return
            self._is_closed = True
            calls, offered = self._calls.copy(), self._offered.copy()

            def end() -> None:
                last()
                for done, _ in calls:
                    done.cancel()
                calls.clear()  # freed in the thread, because to free a query of Zenoh can block
                offered.clear()

            self._calls.clear()
            self._offered.clear()
            self._calls.append((Future(), end))
            self._wake()

    def finish(self, timeout_s: float) -> bool:
        """Make the calls that wait, and no others. Those that take longer than ``timeout_s`` are dropped.

        Returns whether all were made.
        """
        with self._changed:
            self._is_closed = True
            if self._calls or self._offered or self._is_running:
                self._wake()
            if self._changed.wait_for(lambda: not self._is_running, timeout_s):
                return True
            for done, _ in self._calls:
                done.cancel()
            self._calls.clear()
            self._offered.clear()
        return False

    def _wake(self) -> RuntimeError | None:
        """Let the thread see that something has changed; return why it cannot be started."""
        if not self._is_running:
            try:
                thread_starts.start(threading.Thread(target=self._run, name=self._name, daemon=True))
            except RuntimeError as problem:
                return problem
            self._is_running = True
        self._changed.notify_all()
        return None

    # In the thread.

    def _run(self) -> None:
        try:
            while (call := self._next()) is not None:
                self._began_s = time.monotonic()
                call()
                self._began_s = None
                del call  # or what it holds would stay in memory until the next call
        except BaseException:
            # Without memory, anything may raise. The next call starts another thread.
            with self._changed:
                self._began_s = None
                self._is_running = False
                self._changed.notify_all()
            raise

    def _next(self) -> Callable[[], None] | None:
        """Wait for the next call; None if there is none, so that the thread ends."""
        with self._changed:
            idle_s = _IDLE_S if self._ends_when_idle else None
            self._changed.wait_for(lambda: self._calls or self._offered or self._is_closed, idle_s)
            if self._calls:
                return functools.partial(make_call, *self._calls.popleft())
            if self._offered:
                num_bytes, offered = self._offered.popleft()
                self._room.free(num_bytes)
                return offered
            self._is_running = False
            self._changed.notify_all()
            return None


async def result_of(call: Future[_Result]) -> _Result:
    """Return the result of a call, or raise its exception. Cancelling this does not cancel the call.

    What the call raises after that is not logged.
    """
    result = asyncio.wrap_future(call)
    # Otherwise, asyncio logs that an exception was never retrieved.
    result.add_done_callback(lambda done: done.cancelled() or done.exception())
    return await asyncio.shield(result)


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
