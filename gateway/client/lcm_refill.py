"""Asking a gateway on LCM for messages of its history, which it sends again on a channel of their own."""

import contextlib
import json
import re
import threading
from collections.abc import Mapping
from typing import Any, Final

import rtc3d

from gateway.client.history_requests import HistoryAnswer, history_answer
from gateway.client.lcm_requester import LcmRequester
from gateway.errors import OutputError, ProtocolError, QueryError
from gateway.messages.history import MAX_ANSWER_BYTES, sequence_of
from gateway.outputs.lcm.connection import open_lcm, receiving_url
from gateway.outputs.lcm.subscriber import LcmSubscriber

_QUIET_S: Final = 0.3
"""If nothing has arrived for so long, the other messages are lost."""

_MAX_BYTES: Final = 20 * MAX_ANSWER_BYTES
"""How much is kept during a request. What others ask for arrives, too."""

_PREFIX_BYTES: Final = 40


class LcmRefill:
    """Asks for messages with a ``requester``, and receives them on ``url``, in a thread after the first."""

    def __init__(self, url: str, prefix: str, requester: LcmRequester) -> None:
        self._url = url
        self._prefix = prefix
        self._requester = requester
        self._asking = threading.Lock()  # one request at a time: a gateway answers only one
        self._changed = threading.Condition()
        self._subscriber: LcmSubscriber | None = None
        self._reply: Any = None
        self._arrived: dict[str, dict[int, bytes]] = {}  # by channel and number
        self._num_bytes = 0

    def ask(self, channels: str, options: Mapping[str, str], timeout_s: float) -> HistoryAnswer:
        """Ask the source whose channels begin with ``channels`` for messages. Raises QueryError.

        The reply may take ``timeout_s``.
        """
        with self._asking:
            facts = self._request(channels, options, timeout_s)
            try:
                channel, num_messages = str(facts["channel"]), int(facts["num_messages"])
                answer = history_answer(facts, ())
            except (LookupError, TypeError, ValueError, ProtocolError) as error:
                raise QueryError("a reply about messages cannot be read", code="unreadable") from error
            with self._changed:
                while True:
                    arrived = self._arrived.get(channel, {})
                    numbers = sorted(number for number in arrived if answer.first <= number <= answer.last)
                    if len(numbers) >= num_messages or not self._changed.wait(_QUIET_S):
                        messages = [arrived[number] for number in numbers]
                        return answer._replace(messages=messages, is_whole=len(numbers) >= num_messages)

    def overview(self, channels: str, timeout_s: float) -> Mapping[str, Any]:
        """Return which messages there are of each key of a source. Raises QueryError."""
        with self._asking:
            return self._request(channels, {}, timeout_s)

    def _request(self, channels: str, options: Mapping[str, str], timeout_s: float) -> Mapping[str, Any]:
        request = rtc3d.command_request_t()
        request.command = "history"
        request.options = [f"{name}={value}" for name, value in options.items()]
        request.num_options = len(request.options)
        with self._changed:
            self._reply, self._arrived, self._num_bytes = None, {}, 0
        try:
            if self._subscriber is None:
                pattern = f"{re.escape(self._prefix)}_.+_REFILL"
                self._subscriber = LcmSubscriber(open_lcm(receiving_url(self._url)), pattern, self._receive)
            self._requester.send(channels, self._requester.prepare(request, self._take_reply))
        except (OutputError, OSError) as error:
            raise QueryError(str(error), code="timeout") from error
        with self._changed:
            if not self._changed.wait_for(lambda: self._reply is not None, timeout_s):
                raise QueryError("no reply about messages of the history", code="timeout")
            reply = self._reply
        if reply.error:
            raise QueryError(reply.error, code=reply.error_code or "refused")
        try:
            facts = json.loads(reply.content)
        except (ValueError, RecursionError):
            facts = None
        if not isinstance(facts, dict):
            raise QueryError("a reply about messages cannot be read", code="unreadable")
        return facts

    def _take_reply(self, reply: Any) -> None:
        with self._changed:
            self._reply = reply
            self._changed.notify_all()

    def _receive(self, channel: str, message: bytes) -> None:
        with self._changed:
            if len(message) >= _PREFIX_BYTES and self._num_bytes + len(message) <= _MAX_BYTES:
                self._arrived.setdefault(channel, {})[sequence_of(message)] = message
                self._num_bytes += len(message)
                self._changed.notify_all()

    def close(self) -> None:
        """Stop receiving."""
        if self._subscriber is not None:
            with contextlib.suppress(OSError):
                self._subscriber.close()
