"""Sending on LCM from a thread, for the schemes that block: tcpq and file."""

import logging
import threading
from collections import Counter, deque
from collections.abc import Callable
from typing import Final

import lcm

from gateway.errors import OutputError
from gateway.logs.failures import HOLD_S, FailureLog
from gateway.outputs.lcm.connection import BLOCKING_SCHEMES, open_lcm, scheme_of, send_problem
from gateway.outputs.lcm.sender import CLOSED, NOT_OPEN, RETRY_S, LcmSender
from gateway.workers import thread_starts

MAX_QUEUED_BYTES: Final = 8 * 1024 * 1024
MAX_QUEUED_MESSAGES: Final = 10_000
"""The limits of the queue. Further messages are dropped and counted as "queue full"."""

_JOIN_S: Final = 0.5

logger = logging.getLogger(__name__)


class LcmThreadSender:
    """Opens LCM and publishes in a thread, from a bounded queue. It has the methods of LcmSender.

    A peer that accepts the connection but never reads blocks only this thread. A message stays in the queue
    until LCM accepts it: after a failure the thread retries, and ``send`` refuses new messages meanwhile.
    ``on_open`` is called in the thread after LCM has opened. ``what`` names the messages in the log.
    """

    def __init__(self, url: str, on_open: Callable[[], None], what: str = "messages") -> None:
        self._url = url
        self._what = what
        self._on_open = on_open
        self._problem = NOT_OPEN
        self._is_open = False
        self._full = f"{url} does not take messages fast enough; check the peer of lcm.url"
        self._is_full = False  # the queue, when the last message came
        self._queue: deque[tuple[str, bytes, str]] = deque()
        self._queued_bytes = 0
        self._changed = threading.Condition()  # of the queue
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="lcm-send", daemon=True)
        self._opening = FailureLog(logger, "lcm")
        self._sending = FailureLog(logger, "lcm", HOLD_S)
        self._queueing = FailureLog(logger, "lcm", HOLD_S)

    @property
    def problem(self) -> str:
        """Why nothing can be sent now, and what to do; "" if it can."""
        return self._problem or (self._full if self._is_full else "")

    def open(self) -> None:
        """Start the thread, which opens LCM and retries until it succeeds or ``close`` is called."""
        self._problem = f"LCM has not opened {self._url} yet; check lcm.url"
        thread_starts.start(self._thread)

    def send(self, channel: str, message: bytes, source: str = "") -> None:
        """Queue a message about ``source``.

        Raises OutputError if LCM is not open, sending fails or the queue is full.
        """
        if not self._is_open:
            raise OutputError(self._problem, cause="not open")
        if problem := self._problem:
            raise OutputError(problem, cause="send failed")
        with self._changed:
            self._is_full = (
                len(self._queue) >= MAX_QUEUED_MESSAGES
                or self._queued_bytes + len(message) > MAX_QUEUED_BYTES
            )
            if not self._is_full:
                self._queue.append((channel, message, source))
                self._queued_bytes += len(message)
                self._changed.notify()
        if self._is_full:
            self._queueing.failed(self._full)
            raise OutputError(self._full, cause="queue full")
        self._queueing.recovered("the peer reads again")

    def maintain(self) -> None:
        """Do nothing: the thread retries by itself."""

    def close(self) -> Counter[str]:
        """Send the queued messages and end the thread. If a peer blocks it, wait only for _JOIN_S.

        Returns how many messages about each source were not sent.
        """
        with self._changed:
            self._is_open = False  # send() now raises
            self._closing.set()
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(_JOIN_S)
        with self._changed:
            self._problem = CLOSED
            lost = Counter(source for _, _, source in self._queue)
            self._queue.clear()
        return lost

    # In the thread.

    def _run(self) -> None:
        connection = self._open()
        while connection is not None and (first := self._wait_for_first()) is not None:
            if self._publish(connection, *first[:2]):
                self._remove_first()
            elif self._closing.wait(RETRY_S):
                return

    def _open(self) -> lcm.LCM | None:
        """Return LCM after it has opened, with retries; None if ``close`` is called first."""
        while not self._closing.is_set():
            try:
                connection = open_lcm(self._url)
            except OutputError as error:
                self._set_problem(str(error))
                self._opening.failed(str(error))
                self._closing.wait(RETRY_S)
                continue
            with self._changed:
                if self._closing.is_set():
                    return None
                self._problem = ""
                self._is_open = True
            self._opening.succeeded(f"sending {self._what} to {self._url}")
            self._on_open()
            return connection
        return None

    def _wait_for_first(self) -> tuple[str, bytes, str] | None:
        """Return the first message of the queue, once there is one; None if ``close`` was called."""
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._closing.is_set())
            return self._queue[0] if self._queue else None

    def _publish(self, connection: lcm.LCM, channel: str, message: bytes) -> bool:
        """Publish one message; return whether LCM accepted it."""
        try:
            connection.publish(channel, message)
        except OSError as error:
            problem = send_problem(self._url, error)
            self._set_problem(problem)
            self._sending.failed(problem)
            return False
        self._set_problem("")
        self._sending.recovered(f"sending {self._what} to {self._url}")
        return True

    def _remove_first(self) -> None:
        with self._changed:
            if self._queue:  # close() may have cleared it
                _, message, _ = self._queue.popleft()
                self._queued_bytes -= len(message)

    def _set_problem(self, problem: str) -> None:
        with self._changed:
            if not self._closing.is_set():  # close() sets the last one
                self._problem = problem


def new_sender(
    url: str, shared: lcm.LCM | None, on_open: Callable[[], None], what: str = "messages"
) -> LcmSender | LcmThreadSender:
    """Return the sender for the scheme of ``url``, not yet open. Blocking schemes do not use ``shared``."""
    if scheme_of(url) in BLOCKING_SCHEMES:
        return LcmThreadSender(url, on_open, what)
    return LcmSender(url, shared, on_open, what)
