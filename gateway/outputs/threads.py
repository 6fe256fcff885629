"""The thread of an output with an event loop of its own: what its peers do costs it time, not the gateway.

Calls that may block need a WorkerThread instead (gateway/workers.py).
"""

import asyncio
import concurrent.futures
import contextlib
import logging
import threading
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, Final, TypeVar

import uvloop

from gateway.logs.failures import DefectLog
from gateway.workers import QueueRoom, thread_starts


def in_this_loop(call: Callable[..., None]) -> Callable[..., None]:
    """Return a function for any thread that has ``call`` made in the event loop that runs now."""
    loop = asyncio.get_running_loop()

    def call_soon(*arguments: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: the gateway has ended
            loop.call_soon_threadsafe(call, *arguments)

    return call_soon


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
        self._room = QueueRoom()
        self._is_closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        thread_starts.start(self._thread)

    def offer(self, call: Callable[[], None], num_bytes: int = 0) -> bool:
        """Have the loop make ``call``, which holds ``num_bytes``; return False if there is no room for it.

        What ``call`` raises is logged once.
        """
        with self._lock:
            if self._is_closed or not self._room.take(num_bytes):
                return False
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
            self._room.free(num_bytes)
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
