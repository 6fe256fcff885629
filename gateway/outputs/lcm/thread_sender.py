"""Sending on LCM from a thread, for the schemes that block: tcpq and file."""

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Final

import lcm

from gateway.errors import OutputError
from gateway.log import HOLD_S, FailureLog
from gateway.outputs.lcm.connection import open_lcm, send_problem
from gateway.outputs.lcm.sender import CLOSED, NOT_OPEN, RETRY_S

MAX_QUEUED_BYTES: Final = 8 * 1024 * 1024
MAX_QUEUED_MESSAGES: Final = 10_000
"""The limits of the queue. Further messages are dropped and counted as "queue full"."""

_JOIN_S: Final = 0.5

logger = logging.getLogger(__name__)


class LcmThreadSender:
    """Opens LCM and publishes in a thread, from a bounded queue. It has the methods of LcmSender.

    A peer that accepts the connection but never reads blocks only this thread. ``on_open`` is called in the
    thread after LCM has opened. ``what`` names the messages in the log.
    """

    def __init__(self, url: str, on_open: Callable[[], None], what: str = "messages") -> None:
        self.problem = NOT_OPEN
        """Why nothing can be sent now, and what to do; "" if it can."""
        self._url = url
        self._what = what
        self._on_open = on_open
        self._lcm: lcm.LCM | None = None
        self._queue: deque[tuple[str, bytes]] = deque()
        self._queued_bytes = 0
        self._changed = threading.Condition()  # of the queue
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="lcm-send", daemon=True)
        self._opening = FailureLog(logger, "lcm")
        self._sending = FailureLog(logger, "lcm", HOLD_S)
        self._queueing = FailureLog(logger, "lcm", HOLD_S)

    def open(self) -> None:
        """Start the thread, which opens LCM and retries until it succeeds or ``close`` is called."""
        self._thread.start()

    def send(self, channel: str, message: bytes) -> None:
        """Queue a message. Raises OutputError if LCM is not open or the queue is full."""
        if self._lcm is None:
            raise OutputError(self.problem, cause="not open")
        with self._changed:
            is_full = (
                len(self._queue) >= MAX_QUEUED_MESSAGES
                or self._queued_bytes + len(message) > MAX_QUEUED_BYTES
            )
            if not is_full:
                self._queue.append((channel, message))
                self._queued_bytes += len(message)
                self._changed.notify()
        if is_full:
            self._on_full()
        if self._queueing.failing:
            self._queueing.recovered("the peer reads again")

    def _on_full(self) -> None:
        text = f"{self._url} does not take messages fast enough; check the peer of lcm.url"
        self._queueing.failed(text)
        raise OutputError(text, cause="queue full")

    def maintain(self) -> None:
        """Do nothing: the thread retries by itself."""

    def close(self) -> None:
        """Send the queued messages and end the thread. If a peer blocks it, wait only for _JOIN_S."""
        self._lcm = None  # send() now raises
        self._closing.set()
        with self._changed:
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(_JOIN_S)
        self.problem = CLOSED
        if self._queue:
            logger.warning("lcm: closing with %d messages that %s did not take", len(self._queue), self._url)
            self._queue.clear()

    def _run(self) -> None:
        connection = self._open()
        while connection is not None:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._closing.is_set())
                if not self._queue:
                    return
                channel, message = self._queue.popleft()
                self._queued_bytes -= len(message)
            self._publish(connection, channel, message)

    def _open(self) -> lcm.LCM | None:
        """Return LCM after it has opened, with retries; None if ``close`` is called first."""
        while not self._closing.is_set():
            try:
                connection = open_lcm(self._url)
            except OutputError as error:
                self.problem = str(error)
                self._opening.failed(self.problem)
                self._closing.wait(RETRY_S)
                continue
            if self._closing.is_set():
                return None
            self._lcm = connection
            self.problem = ""
            self._opening.succeeded(f"sending {self._what} to {self._url}")
            self._on_open()
            return connection
        return None

    def _publish(self, connection: lcm.LCM, channel: str, message: bytes) -> None:
        try:
            connection.publish(channel, message)
        except OSError as error:
            self.problem = send_problem(self._url, error)
            self._sending.failed(self.problem)
        else:
            if self._sending.failing:
                self.problem = ""
                self._sending.recovered(f"sending {self._what} to {self._url}")
