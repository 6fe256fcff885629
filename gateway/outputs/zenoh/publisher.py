"""The publisher of one Zenoh key: what every message goes through."""

import logging
from collections.abc import Callable
from typing import Any

import zenoh

from gateway.errors import OutputError
from gateway.outputs.encodings import LCM
from gateway.outputs.zenoh.config import zenoh_reason

logger = logging.getLogger(__name__)


class ZenohLink:
    """Whether messages can leave, as all publishers of one output see it.

    ``refusal`` returns the error for a message that cannot leave. Every message reads ``is_cut_off``, so the
    output keeps it up to date instead of working it out.
    """

    def __init__(self, refusal: Callable[[], OutputError]) -> None:
        self.refusal = refusal
        self.is_cut_off = True


class ZenohPublisher:
    """Sends the messages of one key, with DROP on congestion: a stalled subscriber delays nobody."""

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
        publisher.declare_matching_listener(self._on_matching)  # reports subscribers that exist already, too
        self._publisher = publisher

    def check_subscribers(self) -> None:
        """Ask again whether anybody is subscribed: a notification may have been missed."""
        # Zenoh's type stub declares matching_status as a bool; it is the MatchingStatus that listeners get.
        publisher: Any = self._publisher
        if publisher is not None:
            self.wanted = publisher.matching_status.matching

    def _on_matching(self, status: zenoh.MatchingStatus) -> None:
        # Runs in Zenoh's thread, so it only sets a flag.
        self.wanted = status.matching and not self._is_closed

    def publish(self, message: bytes) -> None:
        """Hand ``message`` to Zenoh; raises OutputError while it cannot leave."""
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
