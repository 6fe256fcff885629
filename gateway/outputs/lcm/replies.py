"""Replies to requests from LCM, and messages of the history that are sent again after a reply.

A short reply is sent at once, a long one by a thread.
"""

import functools
import time
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final, NamedTuple

from gateway.errors import OutputError, QueryError
from gateway.messages.topics import lcm_channel
from gateway.outputs.lcm.sender import LcmSender, LcmThreadSender, new_sender
from gateway.outputs.lcm.settings import LcmSettings
from gateway.runtime.losses import Losses
from gateway.runtime.workers import WorkerThread

LONG_REPLY_BYTES: Final = 32 * 1024
"""Longer contents are encoded and sent by a thread: 16 MB take 30 ms."""

_REFILL_BURST_S: Final = 0.002
"""How far messages that are sent again may be ahead of their pace."""


class ReplyContent(NamedTuple):
    """What a reply contains, of ``num_bytes``. ``fill`` writes it to the reply, maybe in another thread.

    ``messages`` follow the reply on a channel of their own.
    """

    num_bytes: int
    fill: Callable[[Any], None]
    messages: tuple[str, list[bytes]] = ("", [])


class RequestKind(NamedTuple):
    """One kind of requests: its types, and the coroutine that answers one about a source.

    Requests come on PREFIX_SOURCE_NAME_REQUEST, replies go to PREFIX_SOURCE_NAME_REPLY. Both types have
    ``request_id`` and ``requester``, and the reply has ``error`` and ``error_code``. ``answer`` raises
    QueryError.
    """

    name: str
    request: type[Any]
    reply: type[Any]
    answer: Callable[[str, Any], Awaitable[ReplyContent]]


class LcmReplies:
    """Sends replies on ``queries_url``, with ``sender`` if that is the output's own URL.

    ``losses`` counts what is lost, by source.
    """

    def __init__(
        self, settings: LcmSettings, sender: LcmSender | LcmThreadSender, losses: Mapping[str, Losses]
    ) -> None:
        self._own_sender: LcmSender | LcmThreadSender | None = None
        if settings.has_own_queries_url:
            self._own_sender = new_sender(settings.effective_queries_url, None, lambda: None, "replies")
        self.sender = self._own_sender or sender
        """Sends on ``queries_url``."""
        self.long_sender = WorkerThread("lcm-send-long")
        """Makes and sends what is long."""
        self.is_refilling = False
        """Whether messages are being sent again."""
        self._prefix = settings.prefix
        self._refill_bytes_per_s = settings.max_reply_bytes_per_s
        self._losses = losses

    def open(self) -> None:
        """Prepare to send, in any thread."""
        if self._own_sender is not None:
            self._own_sender.open()

    def maintain(self) -> None:
        """See LcmSender."""
        if self._own_sender is not None:
            self._own_sender.maintain()

    async def close(self) -> None:
        """Send nothing more."""
        self.long_sender.close()
        if self._own_sender is not None:
            await WorkerThread("close lcm replies").run(self._own_sender.close)  # may wait for a peer

    def check_nobody_is_refilled(self) -> None:
        """Raise QueryError while messages are sent again: everybody gets them, so one request at a time."""
        if self.is_refilling:
            text = "messages are being sent again for another subscriber; try again"
            raise QueryError(text, code="busy")

    # In the event loop.

    def send(self, kind: RequestKind, source: str, request: Any, content: ReplyContent) -> None:
        """Reply to a request, and send the messages that follow."""
        send = functools.partial(self._send_reply, kind, source, request, content.fill)
        channel, messages = content.messages
        if messages:
            self.is_refilling = True
            refill = functools.partial(self._refill, source, send, channel, messages)
            if not self.long_sender.offer(refill, content.num_bytes):
                self.is_refilling = False
                self._drop(kind, source, request)
        elif content.num_bytes <= LONG_REPLY_BYTES:
            send()
        elif not self.long_sender.offer(send, content.num_bytes):
            self._drop(kind, source, request)

    def _drop(self, kind: RequestKind, source: str, request: Any) -> None:
        """Count a long reply that is not sent, and send an error, which is short, instead."""
        self._losses[source].lost(
            "reply beyond the queue",
            "a reply on LCM is dropped, because earlier ones wait to be sent; ask less often",
            frames=0,
        )
        error = QueryError("earlier replies wait to be sent; try again", code="busy")
        self.send_error(kind, source, request, error)

    # In the thread that sends what is long.

    def _refill(self, source: str, reply: Callable[[], None], channel: str, messages: list[bytes]) -> None:
        """Send a reply, and then messages again, no faster than replies may be."""
        try:
            reply()
            pace_s = time.monotonic()
            for message in messages:
                self.sender.send(channel, message)
                pace_s += len(message) / self._refill_bytes_per_s
                if (wait_s := pace_s - time.monotonic()) > _REFILL_BURST_S:
                    time.sleep(wait_s)
        except OutputError as error:
            self._losses[source].lost(error.cause, str(error), frames=0)
        finally:
            self.is_refilling = False

    # In the event loop, or in the thread that sends what is long.

    def send_error(self, kind: RequestKind, source: str, request: Any, error: QueryError) -> None:
        """Reply to a request with an error."""

        def fill(reply: Any) -> None:
            reply.error, reply.error_code = str(error), error.code

        self._send_reply(kind, source, request, fill)

    def _send_reply(self, kind: RequestKind, source: str, request: Any, fill: Callable[[Any], None]) -> None:
        reply = kind.reply()
        reply.request_id, reply.requester = request.request_id, request.requester
        fill(reply)
        try:
            self.sender.send(lcm_channel(self._prefix, source, f"{kind.name}_REPLY"), reply.encode())
        except OutputError as error:
            self._losses[source].lost(error.cause, str(error), frames=0)
