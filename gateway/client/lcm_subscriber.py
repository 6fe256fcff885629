"""Receiving what gateways publish on LCM, and what they reply to requests."""

import itertools
import logging
import re
import uuid
from collections import OrderedDict
from collections.abc import Callable, Collection
from functools import partial
from typing import Any, Final

import rtc3d

from gateway.client.reception import MAX_SERIES, Reception
from gateway.client.series import FINGERPRINTS, POSE, Series, Source
from gateway.client.transport import BUSY_CODES
from gateway.errors import ProtocolError
from gateway.messages.decode import decode
from gateway.messages.texts import xml_bytes
from gateway.messages.topics import lcm_channel
from gateway.outputs.lcm.connection import open_lcm, receiving_url
from gateway.outputs.lcm.subscriber import LcmSubscriber, no_gateway_on_lcm

START_S: Final = 1.2
"""Each source is heard within this time, because it sends a status once a second."""

_POSE_MARK: Final = "_6D_"

_KEYS_BY_FINGERPRINT: Final = {fingerprint: key for key, fingerprint in FINGERPRINTS.items()}

_MAX_WAITING: Final = 4096
"""For how many requests a reply is awaited: a source that never replies must not take up memory."""

logger = logging.getLogger(__name__)


class LcmGatewaySubscriber:
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
        requester: "LcmRequester",
    ) -> None:
        self._url = url
        self._prefix = prefix
        self._names = {lcm_channel(prefix, name): name for name in sources}
        self._reception = reception
        self._series: dict[str, Series | None] = {}  # by channel; None: left out
        self._requester = requester
        self._take_requests: dict[str, Any] = {}
        """The newest request for the takes of each source, by the beginning of its channels."""
        pattern = _pattern(prefix, [*self._names], components)
        self._subscriber = LcmSubscriber(open_lcm(receiving_url(url)), pattern, self._receive)

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

    def _receive_parameters(self, source: Source, reply: Any) -> None:
        if reply.error_code in BUSY_CODES:
            return
        parameters = None
        if not reply.error:
            parameters = self._reception.parameters_message(
                source, xml_bytes(reply.xml), None, reply.parameters_version, min(max(0.0, reply.age_s), 1e9)
            )
        self._reception.answered(source, parameters)

    def _receive_takes(self, source: Source, reply: Any) -> None:
        newest = self._take_requests[source.channels].request_id
        if not reply.error and reply.request_id == newest:
            self._reception.answered_takes(source, reply.content.encode())

    # In the thread of the command.

    def tick(self) -> None:
        """Query the parameters of sources that wait for their description."""
        for source in self._reception.sources_now:
            if source.is_waiting and not source.has_answer and source.begin_query():
                receive = partial(self._receive_parameters, source)
                self._send(source, self._requester.prepare(rtc3d.parameters_request_t(), receive))

    def query_takes(self, source: Source) -> None:
        """See GatewaySubscriber."""
        request = rtc3d.command_request_t()
        request.command = "take"
        receive = partial(self._receive_takes, source)
        self._take_requests[source.channels] = self._requester.prepare(request, receive)
        self._send(source, request)

    def _send(self, source: Source, request: Any) -> None:
        try:
            self._requester.send(source.channels, request)
        except OSError as error:
            logger.debug("asking %s: %s", source.name, error)

    def silence(self) -> str:
        """See GatewaySubscriber."""
        return no_gateway_on_lcm(" ".join(self._names) or self._prefix, self._url)

    def close(self) -> None:
        """See GatewaySubscriber."""
        self._subscriber.close()
        self._requester.close()


def _pattern(prefix: str, channels: Collection[str], components: Collection[str] | None) -> str:
    """Return the regular expression of the channels to subscribe to."""
    sources = "|".join(map(re.escape, channels)) or f"{re.escape(prefix)}_.+"
    if components is None:
        return f"({sources})_.+"
    names = "|".join(
        "6D(_.+)?" if name == "6d" else name.upper() for name in {*components, "status", "parameters"}
    )
    return f"({sources})_({names})"


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
        if (
            isinstance(reply, rtc3d.parameters_reply_t | rtc3d.command_reply_t)
            and reply.requester == self._requester
        ):
            on_reply = self._callbacks.get(reply.request_id)
            if on_reply is not None:
                on_reply(reply)
