"""Sending on LCM from the event loop."""

import logging
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

import lcm

from gateway.errors import OutputError
from gateway.logs.failures import HOLD_S, FailureLog
from gateway.outputs.lcm.connection import open_lcm_to_send, send_problem

_NEVER: Final = float("inf")
RETRY_S: Final = 1.0
"""How long to wait between attempts to open LCM."""

NOT_OPEN: Final = "LCM is not open; start the output first"
CLOSED: Final = "LCM is closed; start the gateway again"

logger = logging.getLogger(__name__)


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
        if self._lcm is None:
            raise OutputError(self.problem, cause="not open")
        try:
            self._lcm.publish(channel, message)
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


class LcmPublisher:
    """Sends the messages of one topic of ``source`` on ``channel``."""

    wanted = True  # LCM cannot know who is subscribed

    def __init__(
        self,
        channel: str,
        source: str,
        send: Callable[[str, bytes, str], None],
        forget: Callable[[Any], None],
    ) -> None:
        self.channel = channel
        self._source = source
        self._send = send
        self._forget = forget
        self._is_closed = False

    def publish(self, message: bytes) -> None:
        """Send one message. Raises OutputError if LCM does not accept it."""
        if self._is_closed:
            raise OutputError(
                f"LCM channel {self.channel} is closed; ask for a new publisher", cause="closed"
            )
        self._send(self.channel, message, self._source)

    def close(self) -> None:
        """Free the channel's name."""
        if not self._is_closed:
            self._is_closed = True
            self._forget(self)
