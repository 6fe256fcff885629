"""Receiving what gateways publish on Zenoh."""

import json
import re
from collections.abc import Collection
from typing import Any, Final
from urllib.parse import unquote

import zenoh

from gateway.client.reception import MAX_SERIES, MAX_XML_BYTES, Reception
from gateway.client.series import POSE, Series, Source
from gateway.client.transport import BUSY_CODES
from gateway.messages.decode import TEXT
from gateway.messages.topics import is_json_key, lcm_channel, zenoh_key
from gateway.outputs.lcm.settings import DEFAULT_LCM_PREFIX
from gateway.outputs.zenoh.subscriber import no_gateway_on_zenoh, served_sources
from gateway.rtc3d.components import COMPONENTS_BY_KEY

_QUERY_S: Final = 1.0

_SOURCE_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,24}")
_NO_KEYS: Final = {"c3d", "recording", "take"}
"""Keys of a source that are not messages: they are ignored, like JSON."""

_PLAIN_KEYS: Final = {*COMPONENTS_BY_KEY, "status", "clock", "parameters"}
_INT32: Final = range(-(1 << 31), 1 << 31)


class ZenohGatewaySubscriber:
    """Subscribes on an open session, which ``close`` closes.

    Each subscription calls ``_receive`` in a thread of its own.
    """

    def __init__(
        self,
        session: zenoh.Session,
        prefix: str,
        sources: Collection[str],
        components: Collection[str] | None,
        reception: Reception[Any, Any],
    ) -> None:
        self._session = session
        self._prefix = prefix
        self._sources = sources
        self._reception = reception
        self._series: dict[str, Series | None] = {}  # by key; None: left out
        for name in self._served():
            self._source(name)
        # Never **: the gateway would make JSON of everything.
        paths = ["*"] if components is None else [*dict.fromkeys((*components, "status", "parameters"))]
        if components is None or "6d" in components:
            paths.append(f"{POSE}*")
        for source in sources or ("*",):
            for path in paths:
                session.declare_subscriber(f"{zenoh_key(prefix, source)}/{path}", self._receive)

    def _served(self) -> list[str]:
        found = served_sources(self._session, self._prefix)
        return [name for name in found if not self._sources or name in self._sources]

    def _source(self, name: str) -> Source | None:
        if not _SOURCE_NAME.fullmatch(name):
            return None
        return self._reception.source(name, lcm_channel(DEFAULT_LCM_PREFIX, name), is_known=True)

    # In Zenoh's threads.

    def _receive(self, sample: zenoh.Sample) -> None:
        try:
            self._sort(sample)
        except Exception as defect:  # noqa: BLE001 - the other messages are received
            self._reception.failed(defect)

    def _sort(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        series = self._series.get(key) or self._find_series(key)
        if series is None:
            return
        if series.key == "parameters":
            self._receive_parameters(series, sample)
        else:
            self._reception.receive(series, sample.payload.to_bytes())

    def _find_series(self, key: str) -> Series | None:
        """Return the series of a key that was not received before; None, counted, if it cannot be."""
        if key in self._series:
            self._reception.ignore(beyond_limit=True)
            return None
        name, _, path = key.removeprefix(f"{self._prefix}/").partition("/")
        if path in _NO_KEYS or is_json_key(path):
            return None
        label = unquote(path.removeprefix(POSE)) if path.startswith(POSE) else None
        if not _SOURCE_NAME.fullmatch(name) or (label is None and path not in _PLAIN_KEYS):
            self._reception.ignore(beyond_limit=False)
            return None
        source = self._source(name)
        names = (path,) if label is None else ("6d", label)
        channel = "" if source is None else lcm_channel(source.channels, *names)
        series = None if source is None else self._reception.series(source, path, channel)
        if len(self._series) < 2 * MAX_SERIES:
            self._series[key] = series
        if series is None:
            self._reception.ignore(beyond_limit=True)
        return series

    def _receive_parameters(self, series: Series, sample: zenoh.Sample) -> None:
        if len(sample.payload) > MAX_XML_BYTES:
            self._reception.ignore(beyond_limit=False)
            return
        self._reception.receive_parameters(
            series, self._parameters_message(series.source, sample), is_made=True
        )

    def _parameters_message(self, source: Source, sample: zenoh.Sample) -> bytes:
        facts = attached_facts(sample)
        return self._reception.parameters_message(
            source,
            sample.payload.to_bytes(),
            _int32(facts.get("session")),
            _int32(facts.get("parameters_version")) or 0,
            _age_s(facts.get("age_s")),
        )

    def _answered_parameters(self, source: Source, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            if len(reply.ok.payload) <= MAX_XML_BYTES:
                self._reception.answered(source, self._parameters_message(source, reply.ok))
        elif reply.err is not None and error_code(reply.err) not in {"", *BUSY_CODES}:
            self._reception.answered(source, None)

    def _answered_status(self, source: Source, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._reception.answered_status(source, reply.ok.payload.to_bytes())

    # In the thread of the command.

    def tick(self) -> None:
        """Query the parameters and the status of sources that wait for their description."""
        for source in self._reception.sources_now:
            if source.is_waiting and source.begin_query():
                self._query(source)

    def _query(self, source: Source) -> None:
        key = zenoh_key(self._prefix, source.name)
        if not source.has_answer:
            self._session.get(
                f"{key}/parameters",
                lambda reply: self._answered_parameters(source, reply),
                timeout=_QUERY_S,
            )
        if source.status is None:
            self._session.get(
                f"{key}/status", lambda reply: self._answered_status(source, reply), timeout=_QUERY_S
            )

    def query_takes(self, source: Source) -> None:
        """See GatewaySubscriber."""

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None and len(reply.ok.payload) <= MAX_XML_BYTES:
                self._reception.answered_takes(source, reply.ok.payload.to_bytes())

        self._session.get(f"{zenoh_key(self._prefix, source.name)}/take", take, timeout=_QUERY_S)

    def silence(self) -> str:
        """See GatewaySubscriber."""
        return no_gateway_on_zenoh(self._prefix, self._sources, served_sources(self._session, self._prefix))

    def close(self) -> None:
        """See GatewaySubscriber."""
        self._session.close()


def attached_facts(sample: zenoh.Sample) -> dict[str, Any]:
    """Return the attachment of a sample; {} if it is no JSON object."""
    try:
        facts = json.loads(b"{}" if sample.attachment is None else sample.attachment.to_bytes())
    except (ValueError, RecursionError):
        return {}
    return facts if isinstance(facts, dict) else {}


def error_code(reply: zenoh.ReplyError) -> str:
    """Return the code of a gateway's error; "" for an error of Zenoh itself."""
    media_type, _, code = str(reply.encoding).partition(";")
    return code if media_type == TEXT else ""


def _int32(value: Any) -> int | None:
    return value if isinstance(value, int) and value in _INT32 else None


def _age_s(value: Any) -> float:
    return float(value) if isinstance(value, int | float) and 0 <= value < 1e9 else 0.0
