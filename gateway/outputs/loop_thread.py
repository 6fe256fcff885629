"""A thread with an event loop of its own, for outputs that are servers on the network.

What a peer does costs this thread time, not the gateway's event loop.
"""

import asyncio
import concurrent.futures
import logging
import threading
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, Final, TypeVar

import uvloop

from gateway.log import DefectLog
from gateway.worker_thread import thread_starts

_Result = TypeVar("_Result")

MAX_CALLS: Final = 4096
MAX_BYTES: Final = 64 * 1024 * 1024
"""The limits of the queue of a LoopThread."""

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
