"""Queries of commands to gateways on Zenoh and LCM: to one source or to all, until there is a reply."""

import re
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import rtc3d
import zenoh

from gateway.cli.gateway_queries import BUSY_CODES, RETRY_S, TimeLimits
from gateway.errors import OutputError, ProtocolError, QueryError
from gateway.messages.decode import TEXT, decode
from gateway.messages.topics import lcm_channel, unique_name
from gateway.outputs.discovery import DISCOVERY_S
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.settings import lcm_queries_url
from gateway.outputs.lcm.subscriber import LcmSubscriber, no_gateway_on_lcm
from gateway.outputs.zenoh.subscriber import no_gateway_on_zenoh, served_sources


class ZenohReply(NamedTuple):
    """A reply about ``source``.

    ``path`` is the rest of its key, ``gateway`` the id of the gateway's session. If several gateways serve
    sources of one name, the second one is called ``lab_2``.
    """

    source: str
    path: tuple[str, ...]
    payload: bytes
    attachment: bytes
    gateway: str


class ZenohClient:
    """Sends queries over ``session``; ``problems`` has what gateways replied instead of an answer.

    ``subject`` is what the queries are about, for error messages.
    """

    def __init__(self, session: zenoh.Session, prefix: str, subject: str) -> None:
        self._session = session
        self._prefix = prefix
        self._subject = subject
        self.problems: list[QueryError] = []
        self._unique_names: dict[tuple[str, str], str] = {}  # by source and the gateway's Zenoh id
        self._no_answer: QueryError | None = None
        """Why nobody has answered yet: too many queries, or too little time."""

    def sources(self, limits: TimeLimits) -> list[str]:
        """Return the sources that gateways serve, sorted. Raises QueryError if none is found in time.

        Gateways are found one after the other, so this looks until the sources stay the same.
        """
        served: list[str] = []
        while (found := served_sources(self._session, self._prefix)) != served or not served:
            if not found and limits.discovery_is_over:
                self._require_gateway(None)
            served = found
            time.sleep(RETRY_S)
        return served

    def query(
        self,
        selectors: Sequence[str],
        source: str | None,
        limits: TimeLimits,
        on_reply: Callable[[ZenohReply], None],
    ) -> None:
        """Send queries, and repeat those without a reply. ``on_reply`` gets each reply.

        Raises QueryError when time is up: that no gateway serves ``source`` (None: any), or does not reply.
        """
        unanswered = self._query_once(selectors, limits, on_reply)
        while unanswered:
            left_s = limits.left_s
            if left_s == 0 or limits.discovery_is_over:
                self._require_gateway(source)
            if left_s == 0:
                raise self._no_answer or limits.no_reply(", ".join(unanswered))
            time.sleep(min(RETRY_S, left_s))
            unanswered = self._query_once(unanswered, limits, on_reply)

    def _query_once(
        self, selectors: Sequence[str], limits: TimeLimits, on_reply: Callable[[ZenohReply], None]
    ) -> list[str]:
        """Send queries and return those without any reply, as happens while Zenoh reconnects.

        A refusal because of too many queries does not count as a reply.
        """
        handlers = {
            # NONE keeps the replies of all gateways: several may serve sources of the same name.
            selector: self._session.get(
                selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=max(0.1, limits.left_s)
            )
            for selector in selectors
        }
        return [
            selector for selector, handler in handlers.items() if not self._receive(handler, limits, on_reply)
        ]

    def _receive(
        self,
        handler: zenoh.handlers.Handler[zenoh.Reply],
        limits: TimeLimits,
        on_reply: Callable[[ZenohReply], None],
    ) -> bool:
        """Pass on the replies to one query; return whether there was any."""
        is_answered = False
        is_late = False
        for reply in handler:
            if reply.ok is not None:
                on_reply(self._reply(reply.ok, str(reply.replier_id)))
            elif reply.err is not None:
                if _is_timeout(reply.err):
                    is_late = True
                    continue
                problem = _problem(reply.err)
                if problem.code in BUSY_CODES:
                    self._no_answer = problem
                    continue
                self.problems.append(problem)
            is_answered = True
        if is_late:
            late = limits.no_reply(self._subject)
            if is_answered:  # by another gateway
                self.problems.append(late)
            else:
                self._no_answer = late
        return is_answered

    def _reply(self, sample: zenoh.Sample, gateway: str) -> ZenohReply:
        source, *path = str(sample.key_expr).removeprefix(f"{self._prefix}/").split("/")
        if (source, gateway) not in self._unique_names:
            self._unique_names[source, gateway] = unique_name(source, set(self._unique_names.values()))
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        name = self._unique_names[source, gateway]
        return ZenohReply(name, tuple(path), sample.payload.to_bytes(), attachment, gateway)

    def _require_gateway(self, source: str | None) -> None:
        """Raise QueryError unless the liveliness token of a gateway that serves ``source`` is found."""
        served = served_sources(self._session, self._prefix)
        problem = no_gateway_on_zenoh(self._prefix, () if source is None else (source,), served)
        if problem:
            raise QueryError(problem, code="no-gateway")


def _is_timeout(reply: zenoh.ReplyError) -> bool:
    """Return whether this is from Zenoh itself, because a gateway or a busy router did not answer in time."""
    return _code(reply) == "" and reply.payload.to_bytes() == b"Timeout"


def _code(reply: zenoh.ReplyError) -> str:
    """Return the code of a gateway's error; "" for an error of Zenoh itself."""
    media_type, _, code = str(reply.encoding).partition(";")
    return code if media_type == TEXT else ""


def _problem(reply: zenoh.ReplyError) -> QueryError:
    text = reply.payload.to_bytes().decode("utf-8", "replace")
    code = _code(reply)
    return QueryError(text, code=code) if code else QueryError(f"Zenoh: {text}", code="zenoh")


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
    return QueryError(no_gateway_on_lcm(name, url), code="no-gateway")
