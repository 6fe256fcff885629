"""Gateways on Zenoh: asking one source or all until there is a reply, and receiving what they publish."""

import contextlib
import json
import math
import re
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, Final
from urllib.parse import unquote

import zenoh
from typing_extensions import override

from gateway.client.history_requests import (
    BUSY_CODES,
    INCOMPLETE,
    Completeness,
    HistoryAnswer,
    HistoryRequest,
    history_answer,
)
from gateway.client.reception import MAX_XML_BYTES, Reception
from gateway.client.sources import POSE, ReceivedSeries, ReceivedSource
from gateway.client.transport import (
    MAX_STATUS_BYTES,
    RETRY_S,
    FoundSources,
    GatewaySubscriber,
    Query,
    QueryReplies,
    QueryReply,
    TimeLimits,
    Transport,
)
from gateway.errors import ProtocolError, QueryError
from gateway.messages.decode import TEXT
from gateway.messages.history import unpack_messages
from gateway.messages.topics import (
    DEFAULT_LCM_PREFIX,
    escape_key_chunk,
    is_json_key,
    lcm_channel,
    unique_name,
    zenoh_key,
)
from gateway.outputs.kind import DISCOVERY_S
from gateway.outputs.zenoh.routers import DESCRIPTIONS, RouterNetwork, read_routers
from gateway.outputs.zenoh.subscriber import no_gateway_on_zenoh, served_sources
from gateway.rtc3d.components import COMPONENTS_BY_KEY

_STATUS_S: Final = 2.0
"""How long a gateway may take to reply with its status."""


class ZenohTransport(Transport):
    """Sends queries over an open session, which ``close`` closes."""

    def __init__(self, session: zenoh.Session, prefix: str) -> None:
        self._session = session
        self._prefix = prefix
        self._unique_names: dict[tuple[str, str], str] = {}  # by source and the gateway's Zenoh id

    # Finding sources.

    @override
    def find(self, wanted: str | None) -> FoundSources:
        """Queries that get an error are repeated."""
        served = self._served()
        found = FoundSources()
        found.absence = self._absence(wanted, served)
        for name in served:
            found.hear(name)
        names = {name for name in served if wanted in {None, name}}
        received: set[tuple[str, str]] = set()
        end_s = time.monotonic() + _STATUS_S
        while names:
            for reply in self._get(zenoh_key(self._prefix, wanted or "*", "status"), _STATUS_S):
                if reply.ok is None:
                    continue
                name = str(reply.ok.key_expr).removeprefix(f"{self._prefix}/").partition("/")[0]
                gateway = "" if reply.replier_id is None else str(reply.replier_id.zid)
                if (name, gateway) not in received:
                    received.add((name, gateway))
                    found.add_status(reply.ok.payload.to_bytes(), name, gateway)
            silent = names.difference(name for name, _ in received)
            if not silent or time.monotonic() >= end_s:
                found.add_silent(sorted(silent))
                break
            time.sleep(RETRY_S)
        found.add_routers(read_routers(self._session, _STATUS_S).names_from)
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

    # Queries.

    @override
    def ask(self, query: Query, source: str | None, timeout_s: float) -> QueryReplies[list[QueryReply]]:
        """It repeats the queries that get no reply, as happens while Zenoh reconnects."""
        limits = TimeLimits(timeout_s)
        replies: QueryReplies[list[QueryReply]] = QueryReplies([], [])
        reason: QueryError | None = None
        try:
            unanswered = self._selectors(query, source)
            while unanswered:
                wait_s = max(0.1, limits.left_s)
                arriving = {selector: self._get(selector, wait_s) for selector in unanswered}
                unanswered = []
                for selector, each in arriving.items():
                    is_answered, problem = self._receive(each, replies, limits.no_reply(query.subject))
                    if not is_answered:
                        unanswered.append(selector)
                        reason = problem or reason
                if unanswered:
                    self._wait_to_repeat(unanswered, source, limits, reason)
        except QueryError as error:
            replies.problems.append(error)
        return replies

    def _selectors(self, query: Query, source: str | None) -> list[str]:
        sources = ["*"] if source is None else [source]
        if source is None and query.key == "take":  # which no wildcard selects
            sources = self._served()
            if absence := self._absence(None, sources):
                raise QueryError(absence, code="no-gateway")
        pairs = ";".join(f"{name}={value}" for name, value in query.options.items())
        options = f"?{pairs}" if pairs else ""
        endings = [f"/{section}{options}" for section in query.sections] or [options]
        keys = [zenoh_key(self._prefix, name, query.key) for name in sources]
        return [key + ending for key in keys for ending in endings]

    def _get(self, selector: str, timeout_s: float) -> zenoh.handlers.Handler[zenoh.Reply]:
        # NONE keeps the replies of all gateways: several may serve sources of the same name.
        return self._session.get(selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=timeout_s)

    def _receive(
        self,
        arriving: zenoh.handlers.Handler[zenoh.Reply],
        replies: QueryReplies[list[QueryReply]],
        late: QueryError,
    ) -> tuple[bool, QueryError | None]:
        """Take the replies to one query; return whether there was any, and else the reason, if known.

        That is ``late`` if a gateway did not answer in time. A refusal, because the gateway is busy, is no
        reply.
        """
        is_answered = is_late = False
        reason: QueryError | None = None
        for reply in arriving:
            if reply.ok is not None:
                replies.received.append(self._reply(reply.ok, str(reply.replier_id)))
                is_answered = True
            elif reply.err is not None:
                code, text = error_code(reply.err), reply.err.payload.to_bytes().decode("utf-8", "replace")
                if not code and text == "Timeout":  # from Zenoh: a gateway or a busy router was too slow
                    is_late = True
                elif code in BUSY_CODES:
                    reason = QueryError(text, code=code)
                else:
                    problem = (
                        QueryError(text, code=code) if code else QueryError(f"Zenoh: {text}", code="zenoh")
                    )
                    replies.problems.append(problem)
                    is_answered = True
        if is_late and is_answered:  # by another gateway
            replies.problems.append(late)
        return is_answered, late if is_late else reason

    def _reply(self, sample: zenoh.Sample, gateway: str) -> QueryReply:
        source, _, *sections = str(sample.key_expr).removeprefix(f"{self._prefix}/").split("/")
        if (source, gateway) not in self._unique_names:
            self._unique_names[source, gateway] = unique_name(source, set(self._unique_names.values()))
        name = self._unique_names[source, gateway]
        return QueryReply(name, tuple(sections), sample.payload.to_bytes(), attached_facts(sample), gateway)

    def _wait_to_repeat(
        self, unanswered: Sequence[str], source: str | None, limits: TimeLimits, reason: QueryError | None
    ) -> None:
        """Wait before a query is repeated. Raises QueryError if time is up: ``reason``, if there is one."""
        left_s = limits.left_s
        if left_s == 0 or limits.discovery_is_over:
            served = served_sources(self._session, self._prefix)
            if absence := self._absence(source, served):
                raise QueryError(absence, code="no-gateway")
        if left_s == 0:
            raise reason or QueryError(
                f"nothing answers {', '.join(unanswered)} although a gateway is running; "
                "the access control of a router may forbid this query",
                code="timeout",
            )
        time.sleep(min(RETRY_S, left_s))

    def _absence(self, source: str | None, served: Collection[str]) -> str:
        """Return that ``source`` (None: any) is not among those that are ``served``; "" if it is."""
        return no_gateway_on_zenoh(self._prefix, () if source is None else (source,), served)

    # Subscribing.

    @override
    def subscribe(
        self,
        sources: Collection[str],
        components: Collection[str] | None,
        reception: Reception[Any, Any],
        completeness: Completeness = INCOMPLETE,
    ) -> "ZenohGatewaySubscriber":
        return ZenohGatewaySubscriber(
            self._session, self._prefix, sources, components, reception, completeness
        )

    @override
    def close(self) -> None:
        self._session.close()


_QUERY_S: Final = 1.0
_KNOWN_S: Final = 5.0
"""When to query again which routers are between, if that is known."""

_SOURCE_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,24}")
_NO_KEYS: Final = {"c3d", "recording", "take"}
"""Keys of a source that are not messages: they are ignored, like JSON."""

_PLAIN_KEYS: Final = {*COMPONENTS_BY_KEY, "status", "clock", "parameters"}
_INT32: Final = range(-(1 << 31), 1 << 31)


class ZenohGatewaySubscriber(GatewaySubscriber):
    """Subscribes on an open session, which ``close`` closes. Each subscription has a thread of its own."""

    def __init__(
        self,
        session: zenoh.Session,
        prefix: str,
        sources: Collection[str],
        components: Collection[str] | None,
        reception: Reception[Any, Any],
        completeness: Completeness,
    ) -> None:
        super().__init__(prefix, components, reception, completeness)
        self._session = session
        self._sources = sources
        self._network = RouterNetwork(session)
        self._gateways: dict[ReceivedSource, str] = {}  # the Zenoh ids of their gateways
        self._queried_s = -math.inf  # when routers were queried
        for name in served_sources(session, prefix):
            if _SOURCE_NAME.fullmatch(name) and (not sources or name in sources):
                self._source(name)
        # Never **: the gateway would make JSON of everything.
        paths = ["*"] if components is None else [*dict.fromkeys((*components, "status", "parameters"))]
        if reception.takes_poses and (components is None or "6d" in components):
            paths.append(f"{POSE}*")
        for source in sources or ("*",):
            for path in paths:
                session.declare_subscriber(
                    f"{zenoh_key(prefix, source)}/{path}",
                    lambda sample: self._receive(str(sample.key_expr), sample.payload.to_bytes(), sample),
                )

    def _source(self, name: str) -> ReceivedSource | None:
        return self._reception.source(name, lcm_channel(DEFAULT_LCM_PREFIX, name), is_known=True)

    def _identify(self, address: str, message: bytes) -> tuple[ReceivedSource | None, str, str] | None:  # noqa: ARG002 - overrides
        name, _, path = address.removeprefix(f"{self._prefix}/").partition("/")
        if path in _NO_KEYS or is_json_key(path):
            return None
        label = unquote(path.removeprefix(POSE)) if path.startswith(POSE) else None
        if not _SOURCE_NAME.fullmatch(name) or (label is None and path not in _PLAIN_KEYS):
            self._reception.ignore(beyond_limit=False)
            return None
        source = self._source(name)
        return source, path, "" if source is None else _channel(source, path)

    def _take(self, series: ReceivedSeries, message: bytes, sample: zenoh.Sample) -> None:
        if series.key != "parameters":
            self._reception.receive(series, message)
        elif len(message) > MAX_XML_BYTES:
            self._reception.ignore(beyond_limit=False)
        else:
            parameters = self._parameters_message(series.source, sample)
            self._reception.receive_parameters(series, parameters, is_made=True)

    def _parameters_message(self, source: ReceivedSource, sample: zenoh.Sample) -> bytes:
        facts = attached_facts(sample)
        age_s = facts.get("age_s")
        return self._reception.parameters_message(
            source,
            sample.payload.to_bytes(),
            _int32(facts.get("session")),
            _int32(facts.get("parameters_version")) or 0,
            float(age_s) if isinstance(age_s, int | float) and 0 <= age_s < 1e9 else 0.0,
        )

    @override
    def _ask_history(
        self, series: ReceivedSeries, request: HistoryRequest, timeout_s: float
    ) -> HistoryAnswer:
        options = ";".join(f"{name}={value}" for name, value in request.options.items())
        selector = f"{zenoh_key(self._prefix, series.source.name)}/{series.key}?{options}"
        first: HistoryAnswer | None = None
        problem: ProtocolError | None = None
        for sample in self._replies(selector, timeout_s):
            try:
                answer = history_answer(attached_facts(sample), unpack_messages(sample.payload.to_bytes()))
            except ProtocolError as error:
                problem = error
                continue
            if request.fits(answer):  # another gateway, or a program that is none, may answer, too
                return answer
            first = first or answer
        if first is None:
            raise QueryError(str(problem), code="zenoh") from problem
        return first

    @override
    def _history_overview(self, source: ReceivedSource, timeout_s: float) -> Mapping[str, Any]:
        sample = self._first_reply(zenoh_key(self._prefix, source.name, "history"), timeout_s)
        overview = None
        if len(sample.payload) <= MAX_STATUS_BYTES:
            with contextlib.suppress(ValueError, RecursionError):
                overview = json.loads(sample.payload.to_bytes())
        return overview if isinstance(overview, dict) else {}

    @override
    def _kept_series(self, source: ReceivedSource, key: str) -> ReceivedSeries | None:
        path = "/".join(map(escape_key_chunk, key.split("/", 1)))
        return self._reception.series(source, path, _channel(source, path))

    def _first_reply(self, selector: str, timeout_s: float) -> zenoh.Sample:
        """Return the first reply that is no error. Raises QueryError if there is none."""
        return next(self._replies(selector, timeout_s))

    def _replies(self, selector: str, timeout_s: float) -> Iterator[zenoh.Sample]:
        """Yield the replies that are no errors. Raises QueryError if there are none."""
        error = QueryError("no gateway keeps these messages", code="no-gateway")
        has_any = False
        try:
            for reply in self._session.get(
                selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=timeout_s
            ):
                if reply.ok is not None:
                    has_any = True
                    yield reply.ok
                elif reply.err is not None:
                    text = reply.err.payload.to_bytes().decode("utf-8", "replace")
                    error = QueryError(text, code=error_code(reply.err) or "timeout")
        except zenoh.ZError as problem:
            error = QueryError(str(problem), code="zenoh")
        if not has_any:
            raise error

    def _query(self, source: ReceivedSource) -> None:
        def take_parameters(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                if len(reply.ok.payload) <= MAX_XML_BYTES:
                    self._reception.answered(source, self._parameters_message(source, reply.ok))
            elif reply.err is not None and error_code(reply.err) not in {"", *BUSY_CODES}:
                self._reception.answered(source, None)

        def take_status(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._reception.answered_status(source, reply.ok.payload.to_bytes())

        if not source.has_answer:
            self._get(source, "parameters", take_parameters)
        if source.status is None:
            self._get(source, "status", take_status)

    @override
    def query_takes(self, source: ReceivedSource) -> None:
        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None and len(reply.ok.payload) <= MAX_XML_BYTES:
                self._reception.answered_takes(source, reply.ok.payload.to_bytes())

        self._get(source, "take", take)

    @override
    def query_routers(self) -> None:
        """It takes what the queries before have found."""
        sources = self._reception.sources_now
        is_known = all(source.routers is not None for source in sources)
        now_s = time.monotonic()
        if now_s - self._queried_s < (_KNOWN_S if is_known else _QUERY_S):
            return
        self._queried_s = now_s
        for source in sources:
            if source in self._gateways:
                source.routers = self._network.names_from(self._gateways[source])
            self._get(source, "status", partial(self._take_gateway, source))
        self._network = RouterNetwork(self._session)
        if self._network.connected:
            self._session.get(DESCRIPTIONS, self._network.add, timeout=_QUERY_S)

    def _take_gateway(self, source: ReceivedSource, reply: zenoh.Reply) -> None:
        if reply.ok is not None and reply.replier_id is not None:
            self._gateways[source] = str(reply.replier_id.zid)

    def _get(self, source: ReceivedSource, key: str, on_reply: Callable[[zenoh.Reply], None]) -> None:
        self._session.get(zenoh_key(self._prefix, source.name, key), on_reply, timeout=_QUERY_S)

    @override
    def silence(self) -> str:
        return no_gateway_on_zenoh(self._prefix, self._sources, served_sources(self._session, self._prefix))

    def _close(self) -> None:
        self._session.close()


def _channel(source: ReceivedSource, path: str) -> str:
    """Return the channel of a key below a source."""
    is_pose = path.startswith(POSE)
    return lcm_channel(source.channels, *(("6d", unquote(path.removeprefix(POSE))) if is_pose else (path,)))


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
