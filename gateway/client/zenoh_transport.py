"""Asking gateways on Zenoh: one source or all, until there is a reply."""

import time
from collections.abc import Collection, Sequence
from typing import Any, Final

import zenoh

from gateway.client.found_sources import FoundSources
from gateway.client.reception import Reception
from gateway.client.transport import BUSY_CODES, RETRY_S, Query, Replies, Reply, TimeLimits, Transport
from gateway.client.zenoh_subscriber import ZenohGatewaySubscriber, attached_facts, error_code
from gateway.errors import QueryError
from gateway.messages.topics import unique_name, zenoh_key
from gateway.outputs.discovery import DISCOVERY_S
from gateway.outputs.zenoh.subscriber import no_gateway_on_zenoh, served_sources

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
    ) -> ZenohGatewaySubscriber:
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
