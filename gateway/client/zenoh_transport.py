"""Gateways on Zenoh: asking one source or all until there is a reply, and receiving what they publish."""

import json
import re
import time
from collections.abc import Collection, Sequence
from typing import Any, Final
from urllib.parse import unquote

import zenoh

from gateway.client.found_sources import FoundSources
from gateway.client.reception import MAX_SERIES, MAX_XML_BYTES, Reception
from gateway.client.series import POSE, Series, Source
from gateway.client.transport import BUSY_CODES, RETRY_S, Query, Replies, Reply, TimeLimits, Transport
from gateway.errors import QueryError
from gateway.messages.decode import TEXT
from gateway.messages.topics import is_json_key, lcm_channel, unique_name, zenoh_key
from gateway.outputs.kind import DISCOVERY_S
from gateway.outputs.lcm.settings import DEFAULT_LCM_PREFIX
from gateway.outputs.zenoh.subscriber import no_gateway_on_zenoh, served_sources
from gateway.rtc3d.components import COMPONENTS_BY_KEY

_STATUS_S: Final = 2.0
"""How long a gateway may take to reply with its status."""

_NEEDS_NAMES: Final = frozenset({"take"})
"""Keys that no wildcard selects."""


class ZenohTransport(Transport):
    """Sends queries over an open session, which ``close`` closes."""

    def __init__(self, session: zenoh.Session, prefix: str) -> None:
        self._session = session
        self._prefix = prefix
        self._unique_names: dict[tuple[str, str], str] = {}  # by source and the gateway's Zenoh id

    # Finding sources.

    def find(self, wanted: str | None) -> FoundSources:
        """See Transport."""
        served = self._served()
        found = FoundSources()
        found.absence = self._absence(wanted, served)
        for name in served:
            found.hear(name)
        names = {name for name in served if wanted in {None, name}}
        received: set[tuple[str, str]] = set()
        end_s = time.monotonic() + _STATUS_S
        while names:
            self._query_statuses(wanted or "*", found, received)
            silent = names.difference(name for name, _ in received)
            if not silent or time.monotonic() >= end_s:
                found.add_silent(sorted(silent))
                break
            time.sleep(RETRY_S)
        return found

    def _served(self) -> list[str]:
        """Return the sources that are served, until they stay the same: gateways are found one by one."""
        end_s = time.monotonic() + DISCOVERY_S
        served: list[str] = []
        while True:
            left_s = end_s - time.monotonic()
            found = sorted({*served, *served_sources(self._session, self._prefix, max(1.0, left_s))})
            if found == served != [] or left_s <= 0:
                return found
            served = found
            time.sleep(RETRY_S)

    def _query_statuses(self, source: str, found: FoundSources, received: set[tuple[str, str]]) -> None:
        """Query every status once. Errors are ignored: the query is repeated."""
        for reply in self._get(zenoh_key(self._prefix, source, "status"), _STATUS_S):
            if reply.ok is None:
                continue
            name = str(reply.ok.key_expr).removeprefix(f"{self._prefix}/").partition("/")[0]
            gateway = "" if reply.replier_id is None else str(reply.replier_id.zid)
            if (name, gateway) not in received:
                received.add((name, gateway))
                found.add_status(reply.ok.payload.to_bytes(), name, gateway)

    # Queries.

    def ask(self, query: Query, source: str | None, timeout_s: float) -> Replies[list[Reply]]:
        """See Transport. It repeats the queries that get no reply, as happens while Zenoh reconnects."""
        exchange = _Exchange(query.subject, TimeLimits(timeout_s))
        try:
            unanswered: Sequence[str] = self._selectors(query, source)
            while unanswered := self._query_once(unanswered, exchange):
                self._wait_to_repeat(unanswered, source, exchange)
        except QueryError as error:
            exchange.problems.append(error)
        return Replies(exchange.received, exchange.problems)

    def _selectors(self, query: Query, source: str | None) -> list[str]:
        if source is not None:
            sources = [source]
        elif query.key in _NEEDS_NAMES:
            sources = self._served()
            self._require_gateway(None, sources)
        else:
            sources = ["*"]
        pairs = ";".join(f"{name}={value}" for name, value in query.options.items())
        options = f"?{pairs}" if pairs else ""
        endings = [f"/{section}{options}" for section in query.sections] or [options]
        keys = [zenoh_key(self._prefix, name, query.key) for name in sources]
        return [key + ending for key in keys for ending in endings]

    def _query_once(self, selectors: Sequence[str], exchange: "_Exchange") -> list[str]:
        """Send queries, and return those without any reply."""
        timeout_s = max(0.1, exchange.limits.left_s)
        replies = {selector: self._get(selector, timeout_s) for selector in selectors}
        return [selector for selector, each in replies.items() if not self._receive(each, exchange)]

    def _get(self, selector: str, timeout_s: float) -> zenoh.handlers.Handler[zenoh.Reply]:
        # NONE keeps the replies of all gateways: several may serve sources of the same name.
        return self._session.get(selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=timeout_s)

    def _receive(self, replies: zenoh.handlers.Handler[zenoh.Reply], exchange: "_Exchange") -> bool:
        """Take the replies to one query; return whether there was any. A refusal, if busy, is none."""
        is_answered = False
        is_late = False
        for reply in replies:
            if reply.ok is not None:
                exchange.received.append(self._reply(reply.ok, str(reply.replier_id)))
            elif reply.err is not None:
                if _is_timeout(reply.err):
                    is_late = True
                    continue
                problem = _problem(reply.err)
                if problem.code in BUSY_CODES:
                    exchange.no_answer = problem
                    continue
                exchange.problems.append(problem)
            is_answered = True
        if is_late:
            exchange.add_late(is_answered=is_answered)
        return is_answered

    def _reply(self, sample: zenoh.Sample, gateway: str) -> Reply:
        source, _, *sections = str(sample.key_expr).removeprefix(f"{self._prefix}/").split("/")
        if (source, gateway) not in self._unique_names:
            self._unique_names[source, gateway] = unique_name(source, set(self._unique_names.values()))
        name = self._unique_names[source, gateway]
        return Reply(name, tuple(sections), sample.payload.to_bytes(), attached_facts(sample), gateway)

    def _wait_to_repeat(self, unanswered: Sequence[str], source: str | None, exchange: "_Exchange") -> None:
        """Wait before a query is repeated. Raises QueryError if time is up."""
        limits = exchange.limits
        left_s = limits.left_s
        if left_s == 0 or limits.discovery_is_over:
            self._require_gateway(source, served_sources(self._session, self._prefix))
        if left_s == 0:
            raise exchange.no_answer or limits.no_reply(", ".join(unanswered))
        time.sleep(min(RETRY_S, left_s))

    def _require_gateway(self, source: str | None, served: Collection[str]) -> None:
        """Raise QueryError unless ``source`` (None: any) is among those that are ``served``."""
        if absence := self._absence(source, served):
            raise QueryError(absence, code="no-gateway")

    def _absence(self, source: str | None, served: Collection[str]) -> str:
        return no_gateway_on_zenoh(self._prefix, () if source is None else (source,), served)

    # Subscribing.

    def subscribe(
        self,
        sources: Collection[str],
        components: Collection[str] | None,
        reception: Reception[Any, Any],
    ) -> "ZenohGatewaySubscriber":
        """See Transport."""
        return ZenohGatewaySubscriber(self._session, self._prefix, sources, components, reception)

    def close(self) -> None:
        """See Transport."""
        self._session.close()


class _Exchange:
    """What has been received in reply to a query about ``subject``, which may be repeated."""

    def __init__(self, subject: str, limits: TimeLimits) -> None:
        self.limits = limits
        self.received: list[Reply] = []
        self.problems: list[QueryError] = []
        self.no_answer: QueryError | None = None
        """Why nobody has answered yet: too many queries, or too little time."""
        self._subject = subject

    def add_late(self, *, is_answered: bool) -> None:
        """Note that a gateway did not answer in time; another one may have (``is_answered``)."""
        late = self.limits.no_reply(self._subject)
        if is_answered:
            self.problems.append(late)
        else:
            self.no_answer = late


def _is_timeout(reply: zenoh.ReplyError) -> bool:
    """Return whether this is from Zenoh itself, because a gateway or a busy router did not answer in time."""
    return error_code(reply) == "" and reply.payload.to_bytes() == b"Timeout"


def _problem(reply: zenoh.ReplyError) -> QueryError:
    text = reply.payload.to_bytes().decode("utf-8", "replace")
    code = error_code(reply)
    return QueryError(text, code=code) if code else QueryError(f"Zenoh: {text}", code="zenoh")


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
