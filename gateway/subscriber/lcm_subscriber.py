"""Receiving what gateways publish on LCM."""

import logging
import re
import uuid
from collections.abc import Collection
from typing import Any, Final

import rtc3d

from gateway.errors import OutputError, ProtocolError
from gateway.messages.decode import decode
from gateway.messages.texts import xml_bytes
from gateway.messages.topics import lcm_channel
from gateway.outputs.lcm.connection import open_lcm, receiving_url
from gateway.outputs.lcm.settings import lcm_queries_url
from gateway.outputs.lcm.subscriber import LcmSubscriber, no_gateway_on_lcm
from gateway.subscriber.reception import MAX_SERIES, Reception
from gateway.subscriber.series import FINGERPRINTS, POSE, Series, Source

START_S: Final = 1.2
"""Each source is heard within this time, because it sends a status once a second."""

_POSE_MARK: Final = "_6D_"

_KEYS_BY_FINGERPRINT: Final = {fingerprint: key for key, fingerprint in FINGERPRINTS.items()}

logger = logging.getLogger(__name__)


class LcmGatewaySubscriber:
    """Subscribes on an LCM URL, and asks on the URL of requests that belongs to it. Raises OutputError.

    Messages are received in one thread, answers in another.
    """

    def __init__(
        self,
        url: str,
        prefix: str,
        sources: Collection[str],
        components: Collection[str] | None,
        reception: Reception[Any, Any],
    ) -> None:
        self._url = url
        self._prefix = prefix
        self._names = {lcm_channel(prefix, name): name for name in sources}
        self._reception = reception
        self._series: dict[str, Series | None] = {}  # by channel; None: left out
        self._requester = f"rtc3d-gateway {uuid.uuid4()}"
        self._by_request_id: dict[int, Source] = {}
        self._take_queries: dict[str, int] = {}
        """The newest request for the takes of each source, by the beginning of its channels."""
        self._num_take_queries = 0
        self._subscribers = [
            LcmSubscriber(
                open_lcm(receiving_url(url)), _pattern(prefix, [*self._names], components), self._receive
            )
        ]
        try:
            self._queries = open_lcm(lcm_queries_url(url))
        except OutputError:
            self._subscribers[0].close()
            raise
        replies = f"{re.escape(prefix)}_.+_(PARAMETERS|COMMAND)_REPLY"
        self._subscribers.append(LcmSubscriber(self._queries, replies, self._receive_reply))

    # In the threads that receive.

    def _receive(self, channel: str, message: bytes) -> None:
        try:
            self._sort(channel, message)
        except Exception as defect:  # noqa: BLE001 - the other messages are received
            self._reception.failed(defect)

    def _sort(self, channel: str, message: bytes) -> None:
        series = self._series.get(channel) or self._find_series(channel, message)
        if series is None:
            return
        if series.key == "parameters" and series.accepts(message):
            self._reception.receive_parameters(series, message, is_made=False)
            return
        self._reception.receive(series, message)
        if series.key == "status" and not series.source.has_known_name:
            self._name(series.source, message)

    def _find_series(self, channel: str, message: bytes) -> Series | None:
        """Return the series of a channel that was not received before; None, counted, if it cannot be."""
        if channel in self._series:
            self._reception.ignore(beyond_limit=True)
            return None
        if channel.endswith(("_REQUEST", "_REPLY", "_RECONNECTED")):
            return None
        key = _KEYS_BY_FINGERPRINT.get(message[:8])
        if key == POSE:
            channels, _, label = channel.rpartition(_POSE_MARK)
            key = f"{POSE}{label}"
        else:
            channels = channel.removesuffix(f"_{key.upper()}") if key else channel
        if not key or channels in {"", channel}:
            self._reception.ignore(beyond_limit=False)
            return None
        source = self._source(channels)
        series = None if source is None else self._reception.series(source, key, channel)
        if len(self._series) < 2 * MAX_SERIES:
            self._series[channel] = series
        if series is None:
            self._reception.ignore(beyond_limit=True)
        return series

    def _source(self, channels: str) -> Source | None:
        name = self._names.get(channels)
        guess = channels.removeprefix(f"{self._prefix}_").lower()
        source = self._reception.source(name or guess, channels, is_known=False)
        if source is not None and name is not None:
            source.has_known_name = True
        return source

    def _name(self, source: Source, status: bytes) -> None:
        """Take the name of a source from its status: its channels have capital letters only."""
        try:
            name = decode(status).source
        except ProtocolError:
            return
        if lcm_channel(self._prefix, name) == source.channels:
            source.name, source.has_known_name = name, True

    def _receive_reply(self, _channel: str, data: bytes) -> None:
        try:
            reply = decode(data)
        except ProtocolError:
            return
        replies = (rtc3d.parameters_reply_t, rtc3d.command_reply_t)
        if not isinstance(reply, replies) or reply.requester != self._requester:
            return
        if isinstance(reply, rtc3d.command_reply_t):
            self._receive_takes(reply)
            return
        source = self._by_request_id.get(reply.request_id)
        if source is None or reply.error_code in {"busy", "rate"}:
            return
        parameters = None
        if not reply.error:
            parameters = self._reception.parameters_message(
                source, xml_bytes(reply.xml), None, reply.parameters_version, min(max(0.0, reply.age_s), 1e9)
            )
        self._reception.answered(source, parameters)

    def _receive_takes(self, reply: rtc3d.command_reply_t) -> None:
        for source in self._reception.sources_now:
            if not reply.error and self._take_queries.get(source.channels) == reply.request_id:
                self._reception.answered_takes(source, reply.content.encode())

    # In the thread of the command.

    def tick(self) -> None:
        """Query the parameters of sources that wait for their description."""
        for source in self._reception.sources_now:
            if source.is_waiting and not source.has_answer and source.begin_query():
                self._query(source)

    def _query(self, source: Source) -> None:
        request = rtc3d.parameters_request_t()
        request.requester = self._requester
        request.request_id = len(self._by_request_id)
        self._by_request_id[request.request_id] = source
        try:
            self._queries.publish(f"{source.channels}_PARAMETERS_REQUEST", request.encode())
        except OSError as error:
            logger.debug("asking for the parameters of %s: %s", source.name, error)

    def query_takes(self, source: Source) -> None:
        """See GatewaySubscriber."""
        request = rtc3d.command_request_t()
        request.requester, request.command = self._requester, "take"
        request.request_id = self._take_queries[source.channels] = self._num_take_queries
        self._num_take_queries += 1
        try:
            self._queries.publish(f"{source.channels}_COMMAND_REQUEST", request.encode())
        except OSError as error:
            logger.debug("asking for the takes of %s: %s", source.name, error)

    def silence(self) -> str:
        """See GatewaySubscriber."""
        return no_gateway_on_lcm(" ".join(self._names) or self._prefix, self._url)

    def close(self) -> None:
        """See GatewaySubscriber."""
        for subscriber in self._subscribers:
            subscriber.close()


def _pattern(prefix: str, channels: Collection[str], components: Collection[str] | None) -> str:
    """Return the regular expression of the channels to subscribe to."""
    sources = "|".join(map(re.escape, channels)) or f"{re.escape(prefix)}_.+"
    if components is None:
        return f"({sources})_.+"
    names = "|".join(
        "6D(_.+)?" if name == "6d" else name.upper() for name in {*components, "status", "parameters"}
    )
    return f"({sources})_({names})"
