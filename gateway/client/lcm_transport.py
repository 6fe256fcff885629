"""Gateways on LCM: asking one source or all until there is a reply, and receiving what they publish."""

import contextlib
import logging
import re
import threading
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

import rtc3d
from typing_extensions import override

from gateway.client.history_requests import (
    BUSY_CODES,
    INCOMPLETE,
    Completeness,
    HistoryAnswer,
    HistoryRequest,
)
from gateway.client.lcm_refill import LcmRefill
from gateway.client.lcm_requester import LcmRequester
from gateway.client.reception import Reception
from gateway.client.sources import FINGERPRINTS, POSE, ReceivedSeries, ReceivedSource
from gateway.client.transport import (
    RETRY_S,
    FoundSources,
    GatewaySubscriber,
    Query,
    QueryReplies,
    QueryReply,
    TimeLimits,
    Transport,
    read_status,
)
from gateway.errors import OutputError, ProtocolError, QueryError
from gateway.messages.decode import decode
from gateway.messages.texts import xml_bytes
from gateway.messages.topics import lcm_channel
from gateway.outputs.kind import DISCOVERY_S, missing_source
from gateway.outputs.lcm.connection import open_lcm, receiving_url
from gateway.outputs.lcm.presence import is_presence
from gateway.outputs.lcm.subscriber import LcmSubscriber, no_gateway_on_lcm
from gateway.runtime.safe_text import safe_text

_LISTEN_S: Final = 1.5
"""Every gateway sends a status within this time. If none is heard, this listens for DISCOVERY_S."""

_POLL_S: Final = 0.05

_CHANNEL: Final = re.compile("_STATUS(_[0-9]+)?$")
"""The end of a channel. Another source with a similar name has a number behind it (topics.unique_name)."""


class LcmTransport(Transport):
    """Finds sources by their status messages on ``url``; requests and replies use ``queries_url``."""

    def __init__(self, url: str, queries_url: str, prefix: str) -> None:
        self._url = url
        self._queries_url = queries_url
        self._prefix = prefix
        self._requester = LcmRequester(queries_url, prefix)

    # Finding sources.

    @override
    def find(self, wanted: str | None) -> FoundSources:
        with self._hear(wanted) as found:
            _wait_for_all(found)
        if not found.heard:
            found.absence = self._no_gateway(wanted)
        elif wanted is not None and not found.sources:
            found.absence = missing_source((wanted,), found.heard)
        return found

    @contextlib.contextmanager
    def _hear(self, wanted: str | None) -> Iterator[FoundSources]:
        """Receive the status messages of sources, in a thread, while the context is open."""
        found = FoundSources()

        def receive(channel: str, message: bytes) -> None:
            """Add the source, unless another is wanted, or it has a longer prefix: MOCAP_HALL."""
            if not found.takes(message):
                return
            source = read_status(message, "")
            if not source.name:
                name = _CHANNEL.split(channel)[0].removeprefix(f"{self._prefix}_").lower()
                source = replace(source, name=safe_text(name))
            channels = lcm_channel(self._prefix, source.name)
            if channel.startswith(channels):
                found.hear(source.name)
                if wanted is None or channels == lcm_channel(self._prefix, wanted):
                    found.add(source)

        pattern = f"{re.escape(self._prefix)}_.+{_CHANNEL.pattern}"
        subscriber = LcmSubscriber(open_lcm(receiving_url(self._url)), pattern, receive)
        try:
            yield found
        finally:
            subscriber.close()

    def _no_gateway(self, wanted: str | None) -> str:
        channels = self._prefix if wanted is None else lcm_channel(self._prefix, wanted)
        return no_gateway_on_lcm(channels, self._url)

    # Queries.

    @override
    def ask(self, query: Query, source: str | None, timeout_s: float) -> QueryReplies[list[QueryReply]]:
        """It repeats requests: they and their replies can get lost."""
        replies: QueryReplies[list[QueryReply]] = QueryReplies([], [])
        with self._hear(source) as found:
            if source is None:
                _wait_for_all(found)
            names = found.readable_names if source is None else [source]
            limits = TimeLimits(timeout_s)
            received = self._exchange(names, query, found, limits)
        if not names:
            replies.problems.append(QueryError(self._no_gateway(None), code="no-gateway"))
        for name in names:
            if (reply := received.get(name)) is not None:
                if reply.error:
                    replies.problems.append(QueryError(reply.error, code=reply.error_code))
                else:
                    replies.received.append(_reply(name, query, reply))
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
            try:
                for source, request in requests.items():
                    if source not in replies:
                        self._requester.send(lcm_channel(self._prefix, source), request)
            except OSError as error:
                raise OutputError(
                    f"LCM did not send to {self._url}: {error}; check --url", cause="send failed"
                ) from error
            left_s = limits.left_s
            # Only a status message shows whether a gateway is missing or does not reply. If none has come
            # when the time for replies is up, wait for one until discovery is over.
            if left_s == 0 and (found.heard or limits.discovery_is_over):
                break
            is_complete.wait(min(RETRY_S, left_s or RETRY_S))
        return refusals | replies

    # Subscribing.

    @override
    def subscribe(
        self,
        sources: Collection[str],
        components: Collection[str] | None,
        reception: Reception[Any, Any],
        completeness: Completeness = INCOMPLETE,
    ) -> "LcmGatewaySubscriber":
        return LcmGatewaySubscriber(
            *(self._url, self._prefix, sources, components, reception, completeness),
            requester=self._requester,
            refill=LcmRefill(self._queries_url, self._prefix, self._requester),
        )

    @override
    def close(self) -> None:
        self._requester.close()


def _wait_for_all(found: FoundSources) -> None:
    """Wait until every gateway has sent a status."""
    start_s = time.monotonic()
    while time.monotonic() < start_s + (_LISTEN_S if found.sources else DISCOVERY_S):
        time.sleep(_POLL_S)


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


def _reply(source: str, query: Query, reply: Any) -> QueryReply:
    if isinstance(reply, rtc3d.command_reply_t):
        return QueryReply(source, (), reply.content.encode())
    facts = {"age_s": reply.age_s, "parameters_version": reply.parameters_version}
    return QueryReply(source, query.sections, xml_bytes(reply.xml), facts)


START_S: Final = 1.2
"""Each source is heard within this time, because it sends a status once a second."""

_POSE_MARK: Final = "_6D_"

_KEYS_BY_FINGERPRINT: Final = {fingerprint: key for key, fingerprint in FINGERPRINTS.items()}

logger = logging.getLogger(__name__)


class LcmGatewaySubscriber(GatewaySubscriber):
    """Subscribes on an LCM URL, and asks with a ``requester``, which ``close`` closes. Raises OutputError.

    Messages are received in one thread, replies in another.
    """

    def __init__(
        self,
        url: str,
        prefix: str,
        sources: Collection[str],
        components: Collection[str] | None,
        reception: Reception[Any, Any],
        completeness: Completeness,
        requester: LcmRequester,
        refill: LcmRefill,
    ) -> None:
        super().__init__(prefix, components, reception, completeness)
        self._url = url
        self._names = {lcm_channel(prefix, name): name for name in sources}
        self._requester = requester
        self._refill = refill
        self._pose_keys: dict[ReceivedSeries, str] = {}
        """The keys of poses on Zenoh: channels do not say the labels of tools exactly."""
        self._take_requests: dict[str, Any] = {}
        """The newest request for the takes of each source, by the beginning of its channels."""
        channels = "|".join(map(re.escape, self._names)) or f"{re.escape(prefix)}_.+"
        keys = ".+"
        if components is not None:
            wanted = {*components, "status", "parameters"}
            tools = "6D(_.+)?" if reception.takes_poses else "6D"
            keys = "|".join(tools if name == "6d" else name.upper() for name in wanted)
        pattern = f"({channels})_({keys})"
        self._subscriber = LcmSubscriber(open_lcm(receiving_url(url)), pattern, self._receive)

    def _identify(self, address: str, message: bytes) -> tuple[ReceivedSource | None, str, str] | None:
        exchange = ("_REQUEST", "_REPLY", "_REFILL", "_RECONNECTED")
        if address.endswith(exchange) or is_presence(address, message):
            return None
        key = _KEYS_BY_FINGERPRINT.get(message[:8])
        if key == POSE and not self._reception.takes_poses:
            return None
        if key == POSE:
            channels, _, label = address.rpartition(_POSE_MARK)
            key = f"{POSE}{label}"
        else:
            channels = address.removesuffix(f"_{key.upper()}") if key else address
        if not key or channels in {"", address}:
            self._reception.ignore(beyond_limit=False)
            return None
        name = self._names.get(channels)
        guess = channels.removeprefix(f"{self._prefix}_").lower()
        source: ReceivedSource | None = self._reception.source(name or guess, channels, is_known=False)
        if source is not None and name is not None:
            source.has_known_name = True
        return source, key, address

    @override
    def _take(self, series: ReceivedSeries, message: bytes, sample: Any) -> None:
        """The status says the name of a source: channels have only capital letters."""
        source = series.source
        if series.key == "parameters" and series.accepts(message):
            self._reception.receive_parameters(series, message, is_made=False)
            return
        self._reception.receive(series, message)
        if series.key == "status" and not source.has_known_name:
            with contextlib.suppress(ProtocolError):
                name = decode(message).source
                if lcm_channel(self._prefix, name) == source.channels:
                    source.name, source.has_known_name = name, True

    @override
    def _ask_history(
        self, series: ReceivedSeries, request: HistoryRequest, timeout_s: float
    ) -> HistoryAnswer:
        key = self._pose_keys.get(series, series.key)
        if key.startswith(POSE) and series not in self._pose_keys:
            for each in self._history_overview(series.source, timeout_s).get("keys", ()):
                if _channel(series.source, each).encode() == series.channel:
                    key = self._pose_keys[series] = each
        return self._refill.ask(series.source.channels, {"key": key, **request.options}, timeout_s)

    @override
    def _history_overview(self, source: ReceivedSource, timeout_s: float) -> Mapping[str, Any]:
        return self._refill.overview(source.channels, timeout_s)

    @override
    def _kept_series(self, source: ReceivedSource, key: str) -> ReceivedSeries | None:
        channel = _channel(source, key)
        is_pose = key.startswith(POSE)
        series_key = f"{POSE}{channel.rpartition(_POSE_MARK)[2]}" if is_pose else key
        series: ReceivedSeries | None = self._reception.series(source, series_key, channel)
        if is_pose and series is not None:
            self._pose_keys[series] = key
        return series

    @override
    def _query(self, source: ReceivedSource) -> None:
        """Every gateway sends its status."""

        def take(reply: Any) -> None:
            if reply.error_code in BUSY_CODES:
                return
            parameters = None
            if not reply.error:
                xml, age_s = xml_bytes(reply.xml), min(max(0.0, reply.age_s), 1e9)
                version = reply.parameters_version
                parameters = self._reception.parameters_message(source, xml, None, version, age_s)
            self._reception.answered(source, parameters)

        if not source.has_answer:
            self._send(source, self._requester.prepare(rtc3d.parameters_request_t(), take))

    @override
    def query_takes(self, source: ReceivedSource) -> None:
        def take(reply: Any) -> None:
            newest = self._take_requests[source.channels].request_id
            if not reply.error and reply.request_id == newest:
                self._reception.answered_takes(source, reply.content.encode())

        request = rtc3d.command_request_t()
        request.command = "take"
        self._take_requests[source.channels] = self._requester.prepare(request, take)
        self._send(source, request)

    def _send(self, source: ReceivedSource, request: Any) -> None:
        try:
            self._requester.send(source.channels, request)
        except OSError as error:
            logger.debug("asking %s: %s", source.name, error)

    @override
    def silence(self) -> str:
        return no_gateway_on_lcm(" ".join(self._names) or self._prefix, self._url)

    def _close(self) -> None:
        self._subscriber.close()
        self._refill.close()
        self._requester.close()


def _channel(source: ReceivedSource, key: str) -> str:
    """Return the channel of a key of the history."""
    return f"{source.channels}{lcm_channel('', *key.split('/', 1))}"
