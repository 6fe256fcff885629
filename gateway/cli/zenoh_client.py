"""Queries of commands on Zenoh: to one source or to all, repeated until there is a reply."""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import zenoh

from gateway.cli.gateway_queries import BUSY_CODES, RETRY_S, TimeLimits
from gateway.errors import QueryError
from gateway.messages.topics import unique_name
from gateway.outputs.encodings import TEXT
from gateway.outputs.zenoh.subscriber import no_gateway, served_sources


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
        problem = no_gateway(self._prefix, () if source is None else (source,), served)
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
