"""Requests of commands on LCM: to one source or to all, repeated until there is a reply."""

import re
import threading
import time
import uuid
from typing import Any, NamedTuple

import rtc3d

from gateway.cli.gateway_queries import BUSY_CODES, RETRY_S, TimeLimits
from gateway.errors import OutputError, ProtocolError, QueryError
from gateway.messages.decode import decode
from gateway.messages.topics import lcm_channel
from gateway.outputs.discovery import DISCOVERY_S
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.settings import lcm_queries_url
from gateway.outputs.lcm.subscriber import LcmSubscriber, no_gateway


class LcmReplies(NamedTuple):
    """The replies by source, and the problems of the others."""

    received: dict[str, Any]
    problems: list[QueryError]


def ask_lcm(
    kind: str,
    request: Any,
    *,
    prefix: str,
    source: str | None,
    url: str,
    queries_url: str | None,
    timeout_s: float,
) -> LcmReplies:
    """Send ``request`` to ``source``, or to every source that is found (None), on PREFIX_SOURCE_KIND_REQUEST.

    This sets its ``requester`` and ``request_id``. Replies come on PREFIX_SOURCE_KIND_REPLY. Sources are
    found by their status messages on ``url``. Requests and replies use ``queries_url``; None means the one
    derived from ``url``. Raises OutputError if LCM does not open or a request cannot be sent.
    """
    client = _LcmClient(url, queries_url or lcm_queries_url(url), prefix, kind, request)
    try:
        sources = client.find_sources() if source is None else [source]
        limits = TimeLimits(timeout_s)
        try:
            client.request(sources, limits)
        except OSError as error:
            raise OutputError(
                f"LCM did not send to {url}: {error}; check --url", cause="send failed"
            ) from error
    finally:
        client.close()
    replies = LcmReplies({}, [])
    if not sources:
        replies.problems.append(_no_gateway(prefix, url))
    for name in sources:
        reply = client.replies.get(name) or client.busy.get(name)
        if reply is not None and not reply.error:
            replies.received[name] = reply
        elif reply is not None:
            replies.problems.append(QueryError(reply.error, code=reply.error_code))
        elif name in client.found_sources:
            replies.problems.append(limits.no_reply(f"source {name!r}"))
        else:
            replies.problems.append(_no_gateway(lcm_channel(prefix, name), url))
    return replies


class _LcmClient:
    """Sends requests, and receives replies and status messages until ``close``."""

    def __init__(self, url: str, queries_url: str, prefix: str, kind: str, request: Any) -> None:
        self._lcm = open_lcm(queries_url)
        self._prefix = prefix
        self._kind = kind
        self._request = request
        request.requester = f"rtc3d-gateway {uuid.uuid4()}"
        self._sources_by_request_id: dict[int, str] = {}
        self.found_sources: set[str] = set()
        """Sources that have sent a status message."""
        self.replies: dict[str, Any] = {}
        """Replies by source."""
        self.busy: dict[str, Any] = {}
        """The replies of gateways that get too many requests; the requests are repeated."""
        self._is_complete = threading.Event()
        channels = f"{re.escape(prefix)}_.+_"
        self._subscribers = [
            LcmSubscriber(self._lcm, f"{channels}{kind}_REPLY", self._receive),
            LcmSubscriber(open_lcm(url), f"{channels}STATUS", self._receive),
        ]

    def _receive(self, _channel: str, data: bytes) -> None:
        try:
            message = decode(data)
        except ProtocolError:
            return
        match message:
            case rtc3d.status_t():
                self.found_sources.add(message.source)
            case rtc3d.parameters_reply_t() | rtc3d.command_reply_t() if (
                message.requester == self._request.requester
            ):
                source = self._sources_by_request_id.get(message.request_id)
                if source is not None:
                    replies = self.busy if message.error_code in BUSY_CODES else self.replies
                    replies.setdefault(source, message)
                if len(self.replies) == len(self._sources_by_request_id):
                    self._is_complete.set()

    def find_sources(self) -> list[str]:
        """Wait for DISCOVERY_S and return the names of all sources that sent a status, sorted."""
        time.sleep(DISCOVERY_S)
        return sorted(self.found_sources.copy())

    def request(self, sources: list[str], limits: TimeLimits) -> None:
        """Send a request to each source, and repeat it until all have replied or time is up."""
        self._sources_by_request_id = dict(enumerate(sources))
        while sources and not self._is_complete.is_set():
            for request_id, source in self._sources_by_request_id.items():
                if source not in self.replies:
                    self._request.request_id = request_id
                    channel = lcm_channel(self._prefix, source, f"{self._kind}_REQUEST")
                    self._lcm.publish(channel, self._request.encode())
            left_s = limits.left_s
            # Only a status message shows whether a gateway is missing or does not reply. If none has come
            # when the time for replies is up, wait for one until discovery is over.
            if left_s == 0 and (self.found_sources or limits.discovery_is_over):
                return
            self._is_complete.wait(min(RETRY_S, left_s or RETRY_S))

    def close(self) -> None:
        """Stop receiving."""
        for subscriber in self._subscribers:
            subscriber.close()


def _no_gateway(name: str, url: str) -> QueryError:
    return QueryError(no_gateway(name, url), code="no-gateway")
