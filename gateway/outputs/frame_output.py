"""What outputs of whole frames have in common, and those of them that serve clients in their own threads.

What the clients do costs that thread time, not the gateway. Calls that may block need a WorkerThread instead
(gateway/runtime/workers.py).
"""

import asyncio
import contextlib
import logging
import threading
from abc import abstractmethod
from collections.abc import Awaitable, Callable, Coroutine
from concurrent.futures import Future
from typing import Any, Final, TypeVar

import uvloop

from gateway.config.settings import OutputSettings
from gateway.errors import PortError
from gateway.messages.topics import Topic
from gateway.outputs.contract import IgnoringPublisher, Output, Publisher
from gateway.runtime.failures import DefectLog, FailureLog, defect_text
from gateway.runtime.workers import QueueRoom, thread_starts

_FIRST_RETRY_S: Final = 0.2
_MAX_RETRY_S: Final = 1.0
"""How long to wait before a port that was in use is tried again: longer each time, up to this."""

_FINISH_S: Final = 0.2
"""How long ``close`` waits for tasks that are running, and again after it has cancelled them."""

_Result = TypeVar("_Result")

logger = logging.getLogger(__name__)


class FrameOutput(Output):
    """An output of whole frames that is replaced if its settings change."""

    settings: OutputSettings

    def publisher(self, topic: Topic) -> Publisher:  # noqa: ARG002 - for all topics
        """Return a publisher that does nothing: status and clock are not published."""
        return IgnoringPublisher()

    def is_configured_like(self, other: Output) -> bool:
        """Return whether the settings are the same."""
        return isinstance(other, FrameOutput) and self.settings == other.settings


class ServerOutput(FrameOutput):
    """An output that serves clients in a thread of its own, so that they cost the sources nothing."""

    close_s: float = 1.0
    """How long ``close`` waits for the thread to end: it has to close all connections."""

    def __init__(self) -> None:
        self._thread: LoopThread | None = None  # from ``start`` on
        self._is_closed = False

    def start(self) -> None:
        """Start the thread, and serve clients there."""
        if self._thread is None and not self._is_closed:
            self._thread = LoopThread(self.name)
            self._serve(self._thread)

    def close(self) -> None:
        """Disconnect all clients and stop listening."""
        self._is_closed = True
        if self._thread is not None:
            self._thread.close(self._stop, self.close_s)

    @abstractmethod
    def _serve(self, thread: "LoopThread") -> None:
        """Have the thread, which has just started, serve clients."""

    @abstractmethod
    async def _stop(self) -> None:
        """Disconnect all clients and stop listening. Called in the thread, as the last thing there."""

    def _offer(self, call: Callable[[], None], num_bytes: int = 0) -> bool:
        """See LoopThread.offer; False if the thread has not started."""
        return self._thread is not None and self._thread.offer(call, num_bytes)


class PortOpener:
    """Opens the port of a server, again and again until it can be used.

    ``subject`` is that of FailureLog. ``problem`` is what to say before the first attempt.
    """

    def __init__(self, logger: logging.Logger, subject: str, problem: str) -> None:
        self.problem = problem
        """Why clients cannot connect, and what to do; "" if they can."""
        self._failures = FailureLog(logger, subject)
        self._defects = DefectLog(logger, subject)

    async def open(self, attempt: Callable[[], Awaitable[_Result]], opened: str) -> _Result:
        """Return what ``attempt`` returns once it does not raise, and log ``opened``.

        ``attempt`` raises PortError, which says what to do, if the port cannot be used.
        """
        delay_s = _FIRST_RETRY_S
        while True:
            try:
                result = await attempt()
            except PortError as error:
                self.problem = str(error)
                self._failures.failed(self.problem)
            except Exception as defect:  # noqa: BLE001 - the next attempt may succeed
                self.problem = f"{defect_text(defect)}; report this with the log"
                self._defects.log(defect)
            else:
                self.problem = ""
                self._failures.succeeded(opened)
                return result
            await asyncio.sleep(delay_s)
            delay_s = min(2 * delay_s, _MAX_RETRY_S)


def in_this_loop(call: Callable[..., None]) -> Callable[..., None]:
    """Return a function for any thread that has ``call`` made in the event loop that runs now."""
    loop = asyncio.get_running_loop()

    def call_soon(*arguments: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: the gateway has ended
            loop.call_soon_threadsafe(call, *arguments)

    return call_soon


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

    def run(self, coroutine: Coroutine[Any, Any, _Result]) -> "Future[_Result]":
        """Run ``coroutine`` in the loop. If the thread is closed, the future is cancelled.

        What it raises is logged, because few callers look at the future.
        """
        with self._lock:
            if not self._is_closed:
                future = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
                future.add_done_callback(self._log_defect)
                return future
        coroutine.close()
        cancelled: Future[_Result] = Future()
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

    def _log_defect(self, future: "Future[Any]") -> None:
        if not future.cancelled() and (defect := future.exception()) is not None:
            self._defects.log(defect)

    async def _end(self, last: Callable[[], Awaitable[None]]) -> None:
        try:
            await last()
            # Such as those that close the port of a source that was withdrawn before. A task that were still
            # pending at the end of the loop would never run its ``finally``.
            if pending := asyncio.all_tasks() - {asyncio.current_task()}:
                _, pending = await asyncio.wait(pending, timeout=_FINISH_S)
            for task in pending:
                task.cancel()
            if pending:
                await asyncio.wait(pending, timeout=_FINISH_S)
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
