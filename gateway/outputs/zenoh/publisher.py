"""The publisher of one Zenoh key."""

import time
from collections.abc import Callable
from typing import Any, Final

import zenoh

from gateway.errors import OutputError
from gateway.messages.decode import LCM
from gateway.outputs.zenoh.config import zenoh_reason
from gateway.outputs.zenoh.confirmation import SentMessages
from gateway.outputs.zenoh.json_publishing import JsonPublisher
from gateway.outputs.zenoh.session import declare_publisher, has_subscribers, undeclare

BURST_BYTES: Final = 128 * 1024
BURST_S: Final = 0.002
"""Zenoh gets at most BURST_BYTES for subscribers in BURST_S, 65 MB per second; more has to wait.

Zenoh itself hardly waits for a subscriber (config.py), because it would wait for each that does not read. So
without this pace, frames that arrive as fast as TCP delivers them would overflow the queue of a subscriber
that reads as fast as it can: 55 to 65 % were lost. This way it is nothing, or 1 % on a busy computer.
"""


class ZenohLink:
    """Whether messages can be sent, and at which pace. All publishers of one output share this object.

    ``refusal`` returns the error for a message that cannot be sent. ``is_cut_off`` is read for every message,
    so the output updates it when something changes.
    """

    def __init__(self, refusal: Callable[[], OutputError]) -> None:
        self.refusal = refusal
        self.is_cut_off = True
        self.burst_bytes_left = BURST_BYTES
        """How many bytes may be published before ``wait_for_pace``."""
        self._next_burst_s = 0.0

    def wait_for_pace(self) -> None:
        """Wait until the next burst may begin: for BURST_S at most, and usually not at all."""
        now_s = time.monotonic()
        if now_s < self._next_burst_s:
            time.sleep(self._next_burst_s - now_s)
            now_s = self._next_burst_s
        self._next_burst_s = now_s + BURST_S
        self.burst_bytes_left = BURST_BYTES


class ZenohPublisher:
    """Sends the messages of one key.

    If a subscriber does not read, Zenoh's queue for it becomes full. Then Zenoh drops messages for this
    subscriber only, almost without waiting (config.py), until it reads again. ``sent`` counts what Zenoh has
    taken for subscribers.
    """

    def __init__(
        self,
        link: ZenohLink,
        key: str,
        type_name: str,
        express: bool,
        forget: Callable[[Any], None],
        sent: SentMessages,
    ) -> None:
        self.wanted = False
        """Whether a subscriber matches the key now, or that of the JSON."""
        self.json: JsonPublisher | None = None
        """Publishes the same messages as JSON; None if nothing does. Set before ``declare``."""
        self._link = link
        self._key = key
        self._type_name = type_name
        self._express = express
        self._forget = forget
        self._sent = sent
        self._publisher: zenoh.Publisher | None = None
        self._is_matched = False
        self._is_closed = False

    def declare(self, session: zenoh.Session) -> None:
        """Declare the publisher on an open session. Any thread may do so."""
        self._publisher = declare_publisher(
            *(session, self._key, self._on_matching),
            encoding=zenoh.Encoding(LCM).with_schema(self._type_name),
            congestion_control=zenoh.CongestionControl.DROP,
            express=self._express,
        )
        if self.json is not None:
            self.json.declare(session)
        # On a busy computer, the first notification may come after short events.
        if has_subscribers(self._publisher):
            self._on_matching(True)
        if self._is_closed:  # by another thread
            self._undeclare()

    def check_subscribers(self) -> None:
        """Check again for subscribers, because a notification may have been missed."""
        publisher = self._publisher
        if self.json is not None:
            self.json.check_subscribers()
        if publisher is not None:
            self._on_matching(has_subscribers(publisher))

    def _on_matching(self, is_matched: bool) -> None:
        # Runs in Zenoh's thread, so it only sets flags.
        self._is_matched = is_matched
        self.update_wanted()

    def update_wanted(self) -> None:
        """Update ``wanted``, because a subscriber to one of the keys came or went."""
        is_matched = self._is_matched or (self.json is not None and self.json.wanted)
        self.wanted = is_matched and not self._is_closed

    def publish(self, message: bytes) -> None:
        """Pass ``message`` to Zenoh. Raises OutputError if it cannot be sent."""
        link = self._link
        if self._publisher is None or link.is_cut_off:
            if self._is_closed:
                text = f"Zenoh key {self._key} is closed; ask for a new publisher"
                raise OutputError(text, cause="closed")
            if not link.is_cut_off:
                raise OutputError(f"Zenoh key {self._key} is not declared yet", cause="not declared")
            raise link.refusal()
        if self.wanted:
            link.burst_bytes_left -= len(message)
            if link.burst_bytes_left < 0:
                link.wait_for_pace()
            if self.json is not None and self.json.wanted:
                self.json.offer(message)
        try:
            self._publisher.put(message)
            if self.wanted:
                self._sent.count += 1
        except zenoh.ZError as error:
            text = f"Zenoh did not take a message for {self._key}: {zenoh_reason(error)}"
            raise OutputError(text, cause="put failed") from error

    def close(self) -> None:
        """Undeclare the publisher."""
        self._is_closed = True
        self.wanted = False
        self._forget(self)
        self._undeclare()

    def _undeclare(self) -> None:
        if self.json is not None:
            self.json.close()
        publisher, self._publisher = self._publisher, None
        undeclare(publisher, self._key)
