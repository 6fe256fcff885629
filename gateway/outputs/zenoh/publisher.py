"""The publisher of one Zenoh key."""

import logging
from collections.abc import Callable
from typing import Any

import zenoh

from gateway.errors import OutputError
from gateway.outputs.encodings import LCM
from gateway.outputs.zenoh.config import zenoh_reason

logger = logging.getLogger(__name__)


class ZenohLink:
    """Whether messages can be sent. All publishers of one output share this object.

    ``refusal`` returns the error for a message that cannot be sent. ``is_cut_off`` is read for every message,
    so the output updates it when something changes.
    """

    def __init__(self, refusal: Callable[[], OutputError]) -> None:
        self.refusal = refusal
        self.is_cut_off = True


class ZenohPublisher:
    """Sends the messages of one key.

    If a subscriber is too slow, ``publish`` waits for at most ``wait_before_drop`` of Zenoh's configuration
    (20 ms). After that, Zenoh drops messages for this subscriber, without waiting, until it reads again.
    """

    def __init__(
        self, link: ZenohLink, key: str, type_name: str, express: bool, forget: Callable[[Any], None]
    ) -> None:
        self.wanted = False
        """Whether a subscriber matches the key now."""
        self._link = link
        self._key = key
        self._type_name = type_name
        self._express = express
        self._forget = forget
        self._publisher: zenoh.Publisher | None = None
        self._is_closed = False

    def declare(self, session: zenoh.Session) -> None:
        """Declare the publisher on an open session."""
        publisher = session.declare_publisher(
            self._key,
            encoding=zenoh.Encoding(LCM).with_schema(self._type_name),
            congestion_control=zenoh.CongestionControl.DROP,
            express=self._express,
        )
        publisher.declare_matching_listener(self._on_matching)  # also reports existing subscribers
        self._publisher = publisher

    def check_subscribers(self) -> None:
        """Check again for subscribers, because a notification may have been missed."""
        # Zenoh's type stub says that matching_status is a bool, but it is a MatchingStatus.
        publisher: Any = self._publisher
        if publisher is not None:
            self.wanted = publisher.matching_status.matching

    def _on_matching(self, status: zenoh.MatchingStatus) -> None:
        # Runs in Zenoh's thread, so it only sets a flag.
        self.wanted = status.matching and not self._is_closed

    def publish(self, message: bytes) -> None:
        """Pass ``message`` to Zenoh. Raises OutputError if it cannot be sent."""
        if self._publisher is None or self._link.is_cut_off:
            raise self._refusal()
        try:
            self._publisher.put(message)
        except zenoh.ZError as error:
            text = f"Zenoh did not take a message for {self._key}: {zenoh_reason(error)}"
            raise OutputError(text, cause="put failed") from error

    def _refusal(self) -> OutputError:
        if self._is_closed:
            return OutputError(f"Zenoh key {self._key} is closed; ask for a new publisher", cause="closed")
        return self._link.refusal()

    def close(self) -> None:
        """Undeclare the publisher."""
        self._is_closed = True
        self.wanted = False
        self._forget(self)
        publisher, self._publisher = self._publisher, None
        if publisher is not None:
            try:
                publisher.undeclare()
            except zenoh.ZError as error:
                logger.debug("undeclaring %s: %s", self._key, error)
