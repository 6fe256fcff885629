"""What the router of a client has certainly read: Zenoh itself does not say what is lost with a connection.

A router that stops reading keeps its connection, and Zenoh goes on accepting messages for it. When Zenoh
gives the connection up, everything in its queue and in the buffers of TCP is gone. So a client asks its
router a question about once a second, which waits behind the messages before it. Its end proves that the
router has read these. What was sent since then may be lost with the connection.
"""

import threading
import time
from collections.abc import Callable, Mapping
from typing import Final

import zenoh

from gateway.outputs.zenoh.session import SessionHolder
from gateway.runtime.losses import Losses

LINK_LOST: Final = "link lost"
"""The cause of loss of what was sent before a connection was given up, and not confirmed."""

SILENT_S: Final = 3.0
"""A router that leaves a question open for this long does not read."""

_KEY: Final = "@rtc3d/confirm"
"""Nobody has anything on this key, and wildcards do not match it, so the router itself ends the question."""

_TIMEOUT_S: Final = 10.0
"""A question that Zenoh has dropped, because its queue was full, is asked again after this time."""


class SentMessages:
    """How many messages of one source were handed to Zenoh. The thread that sends adds to ``count``."""

    def __init__(self) -> None:
        self.count = 0
        self.confirmed = 0
        """How many of them the router has certainly read, or are in ``unconfirmed``."""
        self.unconfirmed = 0
        """How many were in connections that were lost, and are not yet counted as loss."""


class _RouterQuestion:
    """A question to the router, with the number of messages of each source that it waits behind."""

    def __init__(self, counts: dict[SentMessages, int], asked_s: float) -> None:
        self.counts = counts
        self.asked_s = asked_s
        self.is_answered = False
        self.has_failed = False


class RouterConfirmation:
    """Asks the router of ``holder``, if that is the session of a client, and says what may be lost.

    ``check`` is called once a second, in the thread that sends; ``lose_link`` in any thread.
    """

    def __init__(self, holder: SessionHolder, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._holder = holder
        self._monotonic = monotonic
        self._lock = threading.Lock()  # of everything below
        self._sent: dict[str, SentMessages] = {}
        self._question: _RouterQuestion | None = None

    def of(self, source: str) -> SentMessages:
        """Return the count of a source's messages."""
        with self._lock:
            return self._sent.setdefault(source, SentMessages())

    @property
    def silent_s(self) -> float:
        """For how long the router has left a question open; 0.0 if it answers."""
        question = self._question
        return 0.0 if question is None or question.is_answered else self._monotonic() - question.asked_s

    def check(self) -> None:
        """Take the answer to the last question, and ask again."""
        session = self._holder.session
        if session is None or not self._holder.is_client or self._holder.is_cut_off:
            return
        with self._lock:
            question = self._question
            if question is not None and question.is_answered:
                # Not at once: a lost connection ends its questions, too, just before Zenoh reports the loss.
                for sent, count in question.counts.items():
                    sent.confirmed = max(sent.confirmed, count)
            elif question is not None and not question.has_failed:
                return
            asked_s = self._monotonic()
            if question is not None and question.has_failed:
                asked_s = question.asked_s  # the router is silent since then
            counts = {sent: sent.count for sent in self._sent.values()}
            self._question = question = _RouterQuestion(counts, asked_s)
        asked = question

        def on_reply(reply: zenoh.Reply) -> None:
            asked.has_failed = asked.has_failed or reply.ok is None

        def on_end() -> None:
            asked.is_answered = not asked.has_failed

        session.get(
            _KEY,
            zenoh.handlers.Callback(on_reply, on_end, indirect=False),
            timeout=_TIMEOUT_S,
            congestion_control=zenoh.CongestionControl.DROP,
        )

    def lose_link(self) -> None:
        """Note that the connection was lost, with everything that is not confirmed."""
        with self._lock:
            self._question = None
            for sent in self._sent.values():
                count = sent.count
                sent.unconfirmed += count - sent.confirmed
                sent.confirmed = count

    def count_unconfirmed(self, losses: Mapping[str, Losses], router: str) -> None:
        """Count in ``losses``, by source, what may have been lost with connections to ``router``."""
        with self._lock:
            found = [(name, sent.unconfirmed) for name, sent in self._sent.items() if sent.unconfirmed]
            for name, _ in found:
                self._sent[name].unconfirmed = 0
        for name, count in found:
            if name in losses:
                text = (
                    f"up to {count} messages are lost: {router} had not confirmed them when the connection "
                    "to it ended; check whether it was restarted, frozen or overloaded"
                )
                losses[name].lost(LINK_LOST, text, messages=count, frames=0)
