"""The threads of outputs: one for calls that may block, and one with an event loop of its own.

What a peer does costs this thread time, not the gateway's event loop.
"""

import asyncio
import concurrent.futures
import contextlib
import functools
import logging
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine
from concurrent.futures import Future
from typing import Any, Final, TypeVar

import uvloop

from gateway.logs.failures import DefectLog
from gateway.workers import make_call, thread_starts


def in_this_loop(call: Callable[..., None]) -> Callable[..., None]:
    """Return a function for any thread that has ``call`` made in the event loop that runs now."""
    loop = asyncio.get_running_loop()

    def call_soon(*arguments: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: the gateway has ended
            loop.call_soon_threadsafe(call, *arguments)

    return call_soon


MAX_CALLS: Final = 4096
MAX_BYTES: Final = 64 * 1024 * 1024
"""The limits of the queue of a SendThread, for calls that it may refuse."""


class SendThread:
    """Makes calls one after the other in its own thread, which the first call starts.

    Two queues: calls that must be made (``submit``) go first, and their callers bound them. Calls that may be
    given up (``offer``) are refused while too many wait.

    A concurrent.futures.ThreadPoolExecutor does not fit: Python waits for its threads at exit, so a peer that
    has stopped reading would delay the end of the gateway by 5 s.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._changed = threading.Condition()
        self._first: deque[tuple[Future[None], Callable[[], None]]] = deque()
        self._offered: deque[tuple[int, Callable[[], None]]] = deque()
        self._offered_bytes = 0
        self._is_closed = False
        self._last: Callable[[], None]
        self._is_running = False
        self._began_s: float | None = None  # the present call, on the monotonic clock

    def submit(self, call: Callable[[], None]) -> Future[None]:
        """Queue ``call`` before those that were offered.

        The future has its result or exception; it is cancelled if the thread is closed before.
        """
        done: Future[None] = Future()
        with self._changed:
            if self._is_closed:
                done.cancel()
            else:
                self._first.append((done, call))
                self._wake()
        return done

    def offer(self, call: Callable[[], None], num_bytes: int = 0) -> bool:
        """Queue ``call``, which holds ``num_bytes``; return False if the queue is full or closed.

        A call of any size finds a place in an empty queue. ``call`` must not raise.
        """
        with self._changed:
            is_full = len(self._offered) >= MAX_CALLS or self._offered_bytes + num_bytes > MAX_BYTES
            if self._is_closed or (is_full and self._offered):
                return False
            self._offered.append((num_bytes, call))
            self._offered_bytes += num_bytes
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
            self._is_closed = True
            self._last = last
            self._wake()

    def _wake(self) -> None:
        if not self._is_running:
            with contextlib.suppress(RuntimeError):  # the next call tries again
                thread_starts.start(threading.Thread(target=self._run, name=self._name, daemon=True))
                self._is_running = True
        self._changed.notify()

    def _run(self) -> None:
        while (call := self._next()) is not None:
            self._began_s = time.monotonic()
            call()
            self._began_s = None
            del call  # or it would keep its data alive until the next one
        self._last()
        for done, _ in self._first:
            done.cancel()
        # What the other calls hold is freed here, because to free a query of Zenoh can block.
        self._first.clear()
        self._offered.clear()

    def _next(self) -> Callable[[], None] | None:
        """Wait for the next call; None after ``close``."""
        with self._changed:
            self._changed.wait_for(lambda: self._first or self._offered or self._is_closed)
            if self._is_closed:
                return None
            if self._first:
                done, call = self._first.popleft()
                return functools.partial(make_call, done, call)
            num_bytes, offered = self._offered.popleft()
            self._offered_bytes -= num_bytes
            return offered


_Result = TypeVar("_Result")


_FINISH_S: Final = 0.2
"""How long ``close`` waits for tasks that are running, and again after it has cancelled them."""

logger = logging.getLogger(__name__)


class LoopThread:
    """Runs coroutines and calls in an event loop in its own thread. The program does not wait for it at exit.

    Other threads hand over calls with ``offer`` and coroutines with ``run``.
    """

    def __init__(self, name: str) -> None:
        self._loop = uvloop.new_event_loop()
        self._defects = DefectLog(logger, name)
        self._lock = threading.Lock()
        self._num_calls = 0  # that wait
        self._num_bytes = 0  # that they hold
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        thread_starts.start(self._thread)

    def offer(self, call: Callable[[], None], num_bytes: int = 0) -> bool:
        """Have the loop make ``call``, which holds ``num_bytes``; return False if too many wait.

        A call of any size finds a place in an empty queue. What ``call`` raises is logged once.
        """
        with self._lock:
            is_full = self._num_calls >= MAX_CALLS or self._num_bytes + num_bytes > MAX_BYTES
            if self._is_closed or (is_full and self._num_calls):
                return False
            self._num_calls += 1
            self._num_bytes += num_bytes
            self._loop.call_soon_threadsafe(self._make, call, num_bytes)
        return True

    def run(self, coroutine: Coroutine[Any, Any, _Result]) -> "concurrent.futures.Future[_Result]":
        """Run ``coroutine`` in the loop. If the thread is closed, the future is cancelled.

        What it raises is logged, because few callers look at the future.
        """
        with self._lock:
            if not self._is_closed:
                future = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
                future.add_done_callback(self._log_defect)
                return future
        coroutine.close()
        cancelled: concurrent.futures.Future[_Result] = concurrent.futures.Future()
        cancelled.cancel()
        return cancelled

    def close(self, last: Callable[[], Awaitable[None]], timeout_s: float) -> None:
        """Await ``last`` in the loop, then end the thread. Wait for that, but at most ``timeout_s``."""
        with self._lock:
            if self._is_closed:
                return
            self._is_closed = True
            asyncio.run_coroutine_threadsafe(self._end(last), self._loop)
        self._thread.join(timeout_s)

    def _log_defect(self, future: "concurrent.futures.Future[Any]") -> None:
        if not future.cancelled() and (defect := future.exception()) is not None:
            self._defects.log(defect)

    async def _end(self, last: Callable[[], Awaitable[None]]) -> None:
        try:
            await last()
            await _finish(asyncio.all_tasks() - {asyncio.current_task()})
        except Exception as defect:  # noqa: BLE001 - nobody waits for the result
            self._defects.log(defect)
        finally:
            self._loop.stop()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_forever()
        finally:
            self._loop.close()

    def _make(self, call: Callable[[], None], num_bytes: int) -> None:
        with self._lock:
            self._num_calls -= 1
            self._num_bytes -= num_bytes
        self._defects.attempt(call, None)


async def _finish(tasks: "set[asyncio.Task[Any]]") -> None:
    """Wait for tasks, such as those that close the port of a source that was withdrawn before; cancel others.

    A task that were still pending at the end of the loop would never run its ``finally``.
    """
    if tasks:
        _, pending = await asyncio.wait(tasks, timeout=_FINISH_S)
        for task in pending:
            task.cancel()
        if pending:
            await asyncio.wait(pending, timeout=_FINISH_S)
