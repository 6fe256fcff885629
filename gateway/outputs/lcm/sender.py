"""Sending on LCM: from the event loop, or from a thread for the schemes that block (tcpq and file)."""

import functools
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from typing import Final

import lcm

from gateway.errors import OutputError
from gateway.outputs.lcm.connection import BLOCKING_SCHEMES, open_lcm_to_send, scheme_of, send_problem
from gateway.runtime.failures import HOLD_S, FailureLog
from gateway.runtime.workers import WorkerThread

_NEVER: Final = float("inf")
RETRY_S: Final = 1.0
"""How long to wait between attempts to open LCM."""

NOT_OPEN: Final = "LCM is not open; start the output first"
CLOSED: Final = "LCM is closed; start the gateway again"

MAX_QUEUED_BYTES: Final = 8 * 1024 * 1024
MAX_QUEUED_MESSAGES: Final = 10_000
"""The limits of the queue of the thread. Further messages are dropped and counted as "queue full"."""

_JOIN_S: Final = 0.5

logger = logging.getLogger(__name__)


def new_sender(
    url: str, shared: lcm.LCM | None, on_open: Callable[[], None], what: str = "messages"
) -> "LcmSender | LcmThreadSender":
    """Return the sender for the scheme of ``url``, not yet open. Blocking schemes do not use ``shared``."""
    if scheme_of(url) in BLOCKING_SCHEMES:
        return LcmThreadSender(url, on_open, what)
    return LcmSender(url, shared, on_open, what)


class LcmSender:
    """One LCM object for the schemes that publish without blocking: multicast, or in memory.

    ``shared`` is an existing LCM object to use, because memq:// connects only users of one object.
    ``on_open`` is called after LCM has opened. ``what`` names the messages in the log.
    """

    def __init__(
        self, url: str, shared: lcm.LCM | None, on_open: Callable[[], None], what: str = "messages"
    ) -> None:
        self.problem = NOT_OPEN
        """Why nothing can be sent now, and what to do; "" if it can."""
        self._url = url
        self._what = what
        self._shared = shared
        self._on_open = on_open
        self._lcm: lcm.LCM | None = None
        self._retry_at_s = _NEVER
        self._opening = FailureLog(logger, "lcm")
        self._sending = FailureLog(logger, "lcm", HOLD_S)

    def open(self) -> None:
        """Open LCM. If this fails, ``maintain`` tries again."""
        try:
            self._lcm = self._shared or open_lcm_to_send(self._url)
        except OutputError as error:
            self.problem = str(error)
            self._opening.failed(self.problem)
            self._retry_at_s = time.monotonic() + RETRY_S
        else:
            self.problem = ""
            self._opening.succeeded(f"sending {self._what} to {self._url}")
            self._on_open()

    def send(self, channel: str, message: bytes, source: str = "") -> None:  # noqa: ARG002 - nothing waits
        """Publish on ``channel``. Raises OutputError on failure; the next message may succeed."""
        connection = self._lcm  # another thread may close it
        if connection is None:
            raise OutputError(self.problem, cause="not open")
        try:
            connection.publish(channel, message)
        except OSError as error:
            self.problem = send_problem(self._url, error)
            self._sending.failed(self.problem)
            raise OutputError(self.problem, cause="send failed") from error
        if self._sending.failing:
            self.problem = ""
            self._sending.recovered(f"sending {self._what} to {self._url}")

    def maintain(self) -> None:
        """Try to open LCM again, RETRY_S after an attempt that failed."""
        if self._lcm is None and time.monotonic() >= self._retry_at_s:
            self.open()

    def close(self) -> Counter[str]:
        """Release LCM. It has no close(): deleting the object frees its sockets and its thread.

        Returns that no message was waiting.
        """
        self._lcm = None
        self.problem = CLOSED
        self._retry_at_s = _NEVER
        return Counter()


class LcmThreadSender:
    """Opens LCM and publishes in a thread, from a bounded queue. It has the methods of LcmSender.

    A peer that accepts the connection but never reads blocks only this thread. After a failure, the thread
    sends the same message again, and ``send`` refuses new messages meanwhile. ``on_open`` is called in the
    thread after LCM has opened. ``what`` names the messages in the log.
    """

    def __init__(self, url: str, on_open: Callable[[], None], what: str = "messages") -> None:
        self._url = url
        self._on_open = on_open
        self._sender = LcmSender(url, None, self._opened, what)  # used in the thread
        self._is_open = False
        self._is_closed = False
        self._full = f"{url} does not take messages fast enough; check the peer of lcm.url"
        self._is_full = False  # the queue, when the last message came
        self._worker = WorkerThread("lcm-send", MAX_QUEUED_MESSAGES, MAX_QUEUED_BYTES)
        self._opening: Future[None] | None = None
        self._lock = threading.Lock()  # of the next two, and of _is_open
        self._waiting: Counter[str] = Counter()  # messages that LCM has not accepted yet, by source
        self._closing = threading.Event()
        self._has_given_up = False
        self._queueing = FailureLog(logger, "lcm", HOLD_S)

    @property
    def problem(self) -> str:
        """Why nothing can be sent now, and what to do; "" if it can."""
        if self._is_closed:
            return CLOSED
        return self._sender.problem or (self._full if self._is_full else "")

    def open(self) -> None:
        """Start the thread, which opens LCM and retries until it succeeds or ``close`` is called."""
        self._sender.problem = f"LCM has not opened {self._url} yet; check lcm.url"
        self._opening = self._worker.submit(self._open)

    def send(self, channel: str, message: bytes, source: str = "") -> None:
        """Queue a message about ``source``.

        Raises OutputError if LCM is not open, sending fails or the queue is full.
        """
        if not self._is_open:
            raise OutputError(self.problem, cause="not open")
        if problem := self._sender.problem:
            raise OutputError(problem, cause="send failed")
        self._count_waiting(source, 1)
        publish = functools.partial(self._publish, channel, message, source)
        self._is_full = not self._worker.offer(publish, len(message))
        if self._is_full:
            self._count_waiting(source, -1)
            self._queueing.failed(self._full)
            raise OutputError(self._full, cause="queue full")
        self._queueing.recovered("the peer reads again")

    def _count_waiting(self, source: str, number: int) -> None:
        with self._lock:
            self._waiting[source] += number

    def maintain(self) -> None:
        """Open LCM again if no thread could be started; otherwise, the thread retries by itself."""
        call = self._opening
        if call is not None and call.done() and not call.cancelled() and call.exception() is not None:
            self.open()

    def close(self) -> Counter[str]:
        """Send the queued messages and end the thread. If a peer blocks it, wait only for _JOIN_S.

        Returns how many messages about each source were not sent.
        """
        with self._lock:
            self._is_open = False  # send() now raises
            self._closing.set()
        self._worker.finish(_JOIN_S)
        self._is_closed = True
        self._sender.close()  # LCM writes the end of a file when nothing refers to it
        with self._lock:
            return +self._waiting

    # In the thread.

    def _open(self) -> None:
        while not self._closing.is_set() and not self._is_open:
            self._sender.open()
            if not self._is_open:
                self._closing.wait(RETRY_S)

    def _opened(self) -> None:
        with self._lock:
            self._is_open = not self._closing.is_set()
        if self._is_open:
            self._on_open()

    def _publish(self, channel: str, message: bytes, source: str) -> None:
        """Publish a message, with retries; give up when that fails after ``close`` was called."""
        while not self._has_given_up:
            try:
                self._sender.send(channel, message)
            except OutputError:
                self._has_given_up = self._closing.wait(RETRY_S)
            else:
                self._count_waiting(source, -1)
                return


class LcmPublisher:
    """Sends the messages of one topic of ``source`` on ``channel``, which leaves ``channels`` at the end."""

    wanted = True  # LCM cannot know who is subscribed

    def __init__(
        self, channel: str, source: str, sender: LcmSender | LcmThreadSender, channels: set[str]
    ) -> None:
        self.channel = channel
        self._source = source
        self._sender = sender
        self._channels = channels
        self._is_closed = False

    def publish(self, message: bytes) -> None:
        """Send one message. Raises OutputError if LCM does not accept it."""
        if self._is_closed:
            raise OutputError(
                f"LCM channel {self.channel} is closed; ask for a new publisher", cause="closed"
            )
        self._sender.send(self.channel, message, self._source)

    def close(self) -> None:
        """Free the channel's name."""
        if not self._is_closed:
            self._is_closed = True
            self._channels.discard(self.channel)
