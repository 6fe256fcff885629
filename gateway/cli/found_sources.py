"""The sources that gateways serve, found on Zenoh or LCM, with what the gateways report about them."""

import queue
import re
import time
from collections.abc import Iterable
from contextlib import suppress
from typing import Final, NamedTuple

import rtc3d
import zenoh

from gateway.cli.gateway_queries import RETRY_S
from gateway.errors import OutputError, ProtocolError
from gateway.logs.safe_text import safe_text
from gateway.messages.decode import decode, message_type
from gateway.messages.topics import lcm_channel, zenoh_key
from gateway.outputs.discovery import DISCOVERY_S, missing_source
from gateway.outputs.kind import SubscriptionRequest
from gateway.outputs.lcm.connection import open_lcm, receiving_url
from gateway.outputs.lcm.settings import DEFAULT_LCM_PREFIX, effective_lcm_url
from gateway.outputs.lcm.subscriber import LcmSubscriber, no_gateway_on_lcm
from gateway.outputs.zenoh.settings import DEFAULT_ZENOH_PREFIX
from gateway.outputs.zenoh.subscriber import no_gateway_on_zenoh, open_zenoh, served_sources
from gateway.stream.status_text import message_texts

MAX_SOURCES: Final = 1000
"""How many sources are kept. Anybody on the network can send some."""

MAX_STATUS_BYTES: Final = 256 * 1024
_MAX_TOTAL_BYTES: Final = 4 * 1024 * 1024
"""What all statuses together may have: decoding takes about 1 s for this much."""

_MAX_STREAMS: Final = 16
"""How many streams of a source are kept. A source of the gateway has one for each component at most."""

NO_ANSWER: Final = "its gateway does not answer"


class FoundStream(NamedTuple):
    """One stream: what the status line says about it (``text``), and some of its ``stream_status_t``."""

    components: str
    text: str
    state: str
    problem: str
    rate_hz: float
    tries: int


class FoundSource(NamedTuple):
    """One source of one gateway.

    ``gateway`` is the id of the gateway's Zenoh session, or "". If there is no readable status, ``problem``
    says why, and the rest is empty. All texts are safe to print.
    """

    name: str
    gateway: str = ""
    problem: str = ""
    server: str = ""
    host: str = ""
    version: str = ""
    streams: tuple[FoundStream, ...] = ()

    @property
    def components(self) -> list[str]:
        """The components of all streams, each once."""
        return list(dict.fromkeys(key for stream in self.streams for key in stream.components.split()))


class FoundSources:
    """Collects the sources that are found, up to MAX_SOURCES, each with its newest status."""

    def __init__(self) -> None:
        self._sources: dict[tuple[str, ...], FoundSource] = {}
        self._num_bytes = 0
        self.heard: set[str] = set()
        """The names of all sources that were heard, wanted or not, up to MAX_SOURCES."""
        self.num_left_out = 0
        """How many sources or statuses were left out, because there are too many."""

    @property
    def sources(self) -> list[FoundSource]:
        """The sources by name, server and computer."""
        return sorted(self._sources.values())

    def add_status(self, message: bytes, name: str = "", gateway: str = "") -> None:
        """Add the source of a ``status_t``: see ``read_status``."""
        if self.takes(message):
            self.add(read_status(message, name, gateway))

    def takes(self, message: bytes) -> bool:
        """Return whether a message may still be read; count it as left out if not."""
        self._num_bytes += len(message)
        self.num_left_out += self._num_bytes > _MAX_TOTAL_BYTES
        return self._num_bytes <= _MAX_TOTAL_BYTES

    def hear(self, name: str) -> None:
        """Note the name of a source, wanted or not."""
        if len(self.heard) < MAX_SOURCES:
            self.heard.add(safe_text(name))

    def add_silent(self, names: Iterable[str]) -> None:
        """Add sources whose gateways do not answer."""
        for name in names:
            self.add(FoundSource(safe_text(name), problem=NO_ANSWER))

    def add(self, source: FoundSource) -> None:
        """Add a source, or replace what an earlier status said about it."""
        identity = (
            (source.name, source.gateway) if source.gateway else (source.name, source.server, source.host)
        )
        if identity in self._sources or len(self._sources) < MAX_SOURCES:
            self._sources[identity] = source
        else:
            self.num_left_out += 1


def read_status(message: bytes, name: str, gateway: str = "") -> FoundSource:
    """Return what a status says about the source ``name``; if that is "", the status names it.

    The message may come from anybody, and from another version of the gateway.
    """
    if len(message) > MAX_STATUS_BYTES:
        return FoundSource(safe_text(name), gateway, f"its status is too long: {len(message)} bytes")
    try:
        is_status = message_type(message) is rtc3d.status_t
    except ProtocolError:
        is_status = False
    if not is_status:
        return FoundSource(safe_text(name), gateway, "its status is of another version of rtc3d-gateway")
    try:
        status = decode(message)
    except ProtocolError as error:
        return FoundSource(safe_text(name), gateway, f"its status cannot be read: {error}")
    num_streams = len(status.streams)
    status.streams = status.streams[:_MAX_STREAMS]
    return FoundSource(
        safe_text(name or status.source),
        gateway,
        f"it has {num_streams} streams; {_MAX_STREAMS} are shown" if num_streams > _MAX_STREAMS else "",
        safe_text(status.server),
        safe_text(status.host),
        safe_text(status.gateway_version),
        tuple(map(_stream, message_texts(status), status.streams)),
    )


def _stream(text: tuple[str, str], stream: rtc3d.stream_status_t) -> FoundStream:
    return FoundStream(
        *text, safe_text(stream.state), safe_text(stream.problem), stream.frame_rate_hz, stream.tries
    )


_ANSWER_S: Final = 2.0
"""How long a gateway may take to reply with its status."""


def find_on_zenoh(session: zenoh.Session, prefix: str, source: str | None = None) -> FoundSources:
    """Return the sources of all gateways that are found, or only ``source``."""
    served = _served(session, prefix)
    wanted = [name for name in served if source in {None, name}]
    found = FoundSources()
    for name in served:
        found.hear(name)
    received: set[tuple[str, str]] = set()
    end_s = time.monotonic() + _ANSWER_S
    while wanted:
        _query(session, zenoh_key(prefix, source or "*", "status"), prefix, found, received)
        silent = set(wanted).difference(name for name, _ in received)
        if not silent or time.monotonic() >= end_s:
            found.add_silent(sorted(silent))
            break
        time.sleep(RETRY_S)
    return found


def _served(session: zenoh.Session, prefix: str) -> list[str]:
    """Return the sources that are served; gateways are found one after the other."""
    end_s = time.monotonic() + DISCOVERY_S
    served: list[str] = []
    while True:
        left_s = end_s - time.monotonic()
        found = sorted({*served, *served_sources(session, prefix, max(1.0, left_s))})
        if found == served != [] or left_s <= 0:
            return found
        served = found
        time.sleep(RETRY_S)


def _query(
    session: zenoh.Session, selector: str, prefix: str, found: FoundSources, received: set[tuple[str, str]]
) -> None:
    """Query every status once. Errors are ignored: the query is repeated."""
    # NONE keeps the replies of all gateways: several may serve sources of the same name.
    for reply in session.get(selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=_ANSWER_S):
        if reply.ok is None:
            continue
        name = str(reply.ok.key_expr).removeprefix(f"{prefix}/").partition("/")[0]
        gateway = "" if reply.replier_id is None else str(reply.replier_id.zid)
        if (name, gateway) not in received:
            received.add((name, gateway))
            found.add_status(reply.ok.payload.to_bytes(), name, gateway)


_LISTEN_S: Final = 1.5
"""Every gateway sends a status within this time. If none is heard, this listens for DISCOVERY_S."""

_READ_S: Final = 1.0
"""How long to read what has arrived, if it is much."""

_MAX_WAITING: Final = 10_000

_CHANNEL: Final = re.compile("_STATUS(_[0-9]+)?$")
"""The end of a channel. Another source with a similar name has a number behind it (topics.unique_name)."""


def find_on_lcm(url: str, prefix: str, source: str | None = None) -> FoundSources:
    """Return the sources that are heard on ``url``, or only ``source``. Raises OutputError."""
    found = FoundSources()
    num_unread = 0
    received: queue.Queue[tuple[str, bytes]] = queue.Queue(_MAX_WAITING)

    def receive(channel: str, message: bytes) -> None:
        nonlocal num_unread
        try:
            received.put_nowait((channel, message))
        except queue.Full:
            num_unread += 1

    subscriber = LcmSubscriber(
        open_lcm(receiving_url(url)), f"{re.escape(prefix)}_.+{_CHANNEL.pattern}", receive
    )
    start_s = time.monotonic()
    try:
        while (left_s := start_s + (_LISTEN_S if found.sources else DISCOVERY_S) - time.monotonic()) > 0:
            with suppress(queue.Empty):
                _add(found, prefix, source, *received.get(timeout=left_s))
    finally:
        subscriber.close()
    while not received.empty() and time.monotonic() < start_s + DISCOVERY_S + _READ_S:
        _add(found, prefix, source, *received.get())
    found.num_left_out += received.qsize() + num_unread
    return found


def _add(found: FoundSources, prefix: str, wanted: str | None, channel: str, message: bytes) -> None:
    """Add the source of a status, unless another is wanted, or it has a longer prefix: MOCAP_HALL."""
    if not found.takes(message):
        return
    source = read_status(message, "")
    if not source.name:
        source = source._replace(
            name=safe_text(_CHANNEL.split(channel)[0].removeprefix(f"{prefix}_").lower())
        )
    channels = lcm_channel(prefix, source.name)
    if channel.startswith(channels):
        found.hear(source.name)
        if wanted is None or channels == lcm_channel(prefix, wanted):
            found.add(source)


def find_sources(output: str, request: SubscriptionRequest) -> tuple[FoundSources, str]:
    """Return what is found on an output, zenoh or lcm, and why nothing is; "" if something is.

    The component of ``request`` does not matter. Raises OutputError if LCM does not open.
    """
    find = _find_on_lcm if output == "lcm" else _find_on_zenoh
    found, no_gateway = find(request)
    if not found.heard:
        return found, no_gateway
    wanted = () if request.source is None or found.sources else (request.source,)
    return found, missing_source(wanted, found.heard)


def _find_on_zenoh(request: SubscriptionRequest) -> tuple[FoundSources, str]:
    prefix = request.prefix or DEFAULT_ZENOH_PREFIX
    try:
        session = open_zenoh(request.address, request.config)
    except OutputError as error:
        return FoundSources(), str(error)
    try:
        return find_on_zenoh(session, prefix, request.source), no_gateway_on_zenoh(prefix, (), ())
    finally:
        session.close()


def _find_on_lcm(request: SubscriptionRequest) -> tuple[FoundSources, str]:
    prefix, url = request.prefix or DEFAULT_LCM_PREFIX, effective_lcm_url(request.address)
    channels = prefix if request.source is None else lcm_channel(prefix, request.source)
    return find_on_lcm(url, prefix, request.source), no_gateway_on_lcm(channels, url)
