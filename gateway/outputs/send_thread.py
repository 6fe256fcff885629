"""A thread for calls that may block in an output's library. The program does not wait for it when it ends."""

import contextlib
import functools
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Final

from gateway.worker_thread import make_call, thread_starts

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
