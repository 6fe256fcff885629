"""Requests to gateways on LCM, and the replies to them."""

import itertools
import re
import uuid
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, Final

import rtc3d

from gateway.errors import ProtocolError
from gateway.messages.decode import decode
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.subscriber import LcmSubscriber

_MAX_WAITING: Final = 4096
"""For how many requests a reply is awaited: a source that never replies must not take up memory."""


class LcmRequester:
    """Sends requests on PREFIX_SOURCE_KIND_REQUEST, and receives the replies on PREFIX_SOURCE_KIND_REPLY.

    ``url`` is that of requests. A thread calls the callback of a request with each reply to it. Raises
    OutputError if LCM does not open.
    """

    def __init__(self, url: str, prefix: str) -> None:
        self._lcm = open_lcm(url)
        self._requester = f"rtc3d-gateway {uuid.uuid4()}"
        self._numbers = itertools.count()
        self._callbacks: OrderedDict[int, Callable[[Any], object]] = OrderedDict()
        replies = f"{re.escape(prefix)}_.+_(PARAMETERS|COMMAND)_REPLY"
        self._subscriber = LcmSubscriber(self._lcm, replies, self._receive)

    def prepare(self, request: Any, on_reply: Callable[[Any], object]) -> Any:
        """Return the request with a number of its own, with which ``send`` may send and repeat it."""
        request.requester, request.request_id = self._requester, next(self._numbers)
        self._callbacks[request.request_id] = on_reply
        if len(self._callbacks) > _MAX_WAITING:
            self._callbacks.popitem(last=False)
        return request

    def send(self, channels: str, request: Any) -> None:
        """Send a prepared request to the source whose channels begin with ``channels``. Raises OSError."""
        kind = "COMMAND" if isinstance(request, rtc3d.command_request_t) else "PARAMETERS"
        self._lcm.publish(f"{channels}_{kind}_REQUEST", request.encode())

    def close(self) -> None:
        """Stop receiving."""
        self._subscriber.close()

    def _receive(self, _channel: str, data: bytes) -> None:
        try:
            reply = decode(data)
        except ProtocolError:
            return
        is_reply = isinstance(reply, rtc3d.parameters_reply_t | rtc3d.command_reply_t)
        if is_reply and reply.requester == self._requester:
            self._callbacks.get(reply.request_id, lambda _reply: None)(reply)
