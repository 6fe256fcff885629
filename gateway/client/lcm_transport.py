"""Asking gateways on LCM: one source or all, until there is a reply."""

import re
import threading
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any, Final

import rtc3d

from gateway.client.found_sources import FoundSources, read_status
from gateway.client.lcm_subscriber import LcmGatewaySubscriber, LcmRequester
from gateway.client.reception import Reception
from gateway.client.transport import BUSY_CODES, RETRY_S, Query, Replies, Reply, TimeLimits, Transport
from gateway.errors import OutputError, QueryError
from gateway.logs.safe_text import safe_text
from gateway.messages.texts import xml_bytes
from gateway.messages.topics import lcm_channel
from gateway.outputs.discovery import DISCOVERY_S, missing_source
from gateway.outputs.lcm.connection import open_lcm, receiving_url
from gateway.outputs.lcm.subscriber import LcmSubscriber, no_gateway_on_lcm

_LISTEN_S: Final = 1.5
"""Every gateway sends a status within this time. If none is heard, this listens for DISCOVERY_S."""

_POLL_S: Final = 0.05

_CHANNEL: Final = re.compile("_STATUS(_[0-9]+)?$")
"""The end of a channel. Another source with a similar name has a number behind it (topics.unique_name)."""


class LcmTransport(Transport):
    """Finds sources by their status messages on ``url``; requests and replies use ``queries_url``."""

    def __init__(self, url: str, queries_url: str, prefix: str) -> None:
        self._url = url
        self._prefix = prefix
        self._requester = LcmRequester(queries_url, prefix)

    # Finding sources.

    def find(self, wanted: str | None) -> FoundSources:
        """See Transport."""
        with self._hear(wanted) as found:
            _wait_for_all(found)
        if not found.heard:
            found.absence = self._no_gateway(wanted)
        elif wanted is not None and not found.sources:
            found.absence = missing_source((wanted,), found.heard)
        return found

    @contextmanager
    def _hear(self, wanted: str | None) -> Iterator[FoundSources]:
        """Receive the status messages of sources, in a thread, while the context is open."""
        found = FoundSources()
        channels = f"{re.escape(self._prefix)}_.+{_CHANNEL.pattern}"
        receive = partial(_add, found, self._prefix, wanted)
        subscriber = LcmSubscriber(open_lcm(receiving_url(self._url)), channels, receive)
        try:
            yield found
        finally:
            subscriber.close()

    def _no_gateway(self, wanted: str | None) -> str:
        channels = self._prefix if wanted is None else lcm_channel(self._prefix, wanted)
        return no_gateway_on_lcm(channels, self._url)

    # Queries.

    def ask(self, query: Query, source: str | None, timeout_s: float) -> Replies[list[Reply]]:
        """See Transport. It repeats requests: they and their replies can get lost."""
        replies: Replies[list[Reply]] = Replies([], [])
        with self._hear(source) as found:
            if source is None:
                _wait_for_all(found)
            names = found.readable_names if source is None else [source]
            limits = TimeLimits(timeout_s)
            received = self._exchange(names, query, found, limits)
        if not names:
            replies.problems.append(QueryError(self._no_gateway(None), code="no-gateway"))
        for name in names:
            reply = received.get(name)
            if reply is not None and not reply.error:
                replies.received.append(_reply(name, query, reply))
            elif reply is not None:
                replies.problems.append(QueryError(reply.error, code=reply.error_code))
            elif name in found.heard:
                replies.problems.append(limits.no_reply(f"source {name!r}"))
            else:
                replies.problems.append(QueryError(self._no_gateway(name), code="no-gateway"))
        return replies

    def _exchange(
        self, sources: Sequence[str], query: Query, found: FoundSources, limits: TimeLimits
    ) -> dict[str, Any]:
        """Ask each source until all have replied or time is up; return the replies by source."""
        replies: dict[str, Any] = {}
        refusals: dict[str, Any] = {}
        is_complete = threading.Event()

        def receive(source: str, reply: Any) -> None:
            (refusals if reply.error_code in BUSY_CODES else replies).setdefault(source, reply)
            if len(replies) == len(sources):
                is_complete.set()

        requests = {
            source: self._requester.prepare(_request(query), partial(receive, source)) for source in sources
        }
        while sources and not is_complete.is_set():
            for source, request in requests.items():
                if source not in replies:
                    self._send(source, request)
            left_s = limits.left_s
            # Only a status message shows whether a gateway is missing or does not reply. If none has come
            # when the time for replies is up, wait for one until discovery is over.
            if left_s == 0 and (found.heard or limits.discovery_is_over):
                break
            is_complete.wait(min(RETRY_S, left_s or RETRY_S))
        return refusals | replies

    def _send(self, source: str, request: Any) -> None:
        try:
            self._requester.send(lcm_channel(self._prefix, source), request)
        except OSError as error:
            raise OutputError(
                f"LCM did not send to {self._url}: {error}; check --url", cause="send failed"
            ) from error

    # Subscribing.

    def subscribe(
        self,
        sources: Collection[str],
        components: Collection[str] | None,
        reception: Reception[Any, Any],
    ) -> LcmGatewaySubscriber:
        """See Transport."""
        return LcmGatewaySubscriber(self._url, self._prefix, sources, components, reception, self._requester)

    def close(self) -> None:
        """See Transport."""
        self._requester.close()


def _wait_for_all(found: FoundSources) -> None:
    """Wait until every gateway has sent a status."""
    start_s = time.monotonic()
    while time.monotonic() < start_s + (_LISTEN_S if found.sources else DISCOVERY_S):
        time.sleep(_POLL_S)


def _add(found: FoundSources, prefix: str, wanted: str | None, channel: str, message: bytes) -> None:
    """Add the source of a status, unless another is wanted, or it has a longer prefix: MOCAP_HALL."""
    if not found.takes(message):
        return
    source = read_status(message, "")
    if not source.name:
        source = replace(
            source, name=safe_text(_CHANNEL.split(channel)[0].removeprefix(f"{prefix}_").lower())
        )
    channels = lcm_channel(prefix, source.name)
    if channel.startswith(channels):
        found.hear(source.name)
        if wanted is None or channels == lcm_channel(prefix, wanted):
            found.add(source)


def _request(query: Query) -> Any:
    """Return the request for a query. Only parameters have a type of their own."""
    request: Any
    if query.key == "parameters":
        request = rtc3d.parameters_request_t()
        request.sections, request.num_sections = list(query.sections), len(query.sections)
        request.fresh = "fresh" in query.options
        return request
    request = rtc3d.command_request_t()
    request.command = query.key
    request.options = [f"{name}={value}" for name, value in query.options.items()]
    request.num_options = len(request.options)
    return request


def _reply(source: str, query: Query, reply: Any) -> Reply:
    if isinstance(reply, rtc3d.command_reply_t):
        return Reply(source, (), reply.content.encode())
    facts = {"age_s": reply.age_s, "parameters_version": reply.parameters_version}
    return Reply(source, query.sections, xml_bytes(reply.xml), facts)
