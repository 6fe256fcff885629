"""Parameter queries on Zenoh."""

import contextlib
import json
import time
from collections.abc import Callable

import zenoh

from gateway.cli.params_query import BUSY_CODES, RETRY_S, ParametersReply, Replies, Sections, TimeLimits
from gateway.errors import OutputError, QueryError
from gateway.messages.topics import unique_name, zenoh_key
from gateway.outputs.encodings import TEXT


def query_zenoh(
    prefix: str,
    source: str | None,
    sections: Sections,
    *,
    fresh: bool,
    open_session: Callable[[], zenoh.Session],
    timeout_s: float,
) -> Replies:
    """Query each of ``sections`` from the gateways that serve ``source``, or from all gateways (None).

    If ``open_session`` raises OutputError, that is one of the problems, not an exception.
    """
    replies = Replies([], [])
    try:
        session = open_session()
    except OutputError as error:
        replies.problems.append(QueryError(str(error), code="no-gateway"))
        return replies
    key = zenoh_key(prefix, source or "*") + "/parameters"
    keys = [f"{key}/{section}" for section in sections] or [key]
    try:
        _ZenohClient(session, prefix, TimeLimits(timeout_s), replies).query(keys, source, fresh=fresh)
    except QueryError as error:
        replies.problems.append(error)
    finally:
        session.close()
    return replies


class _ZenohClient:
    """Sends queries over ``session`` and adds the replies and problems to ``replies``."""

    def __init__(self, session: zenoh.Session, prefix: str, limits: TimeLimits, replies: Replies) -> None:
        self._session = session
        self._prefix = prefix
        self._limits = limits
        self._replies = replies
        self._unique_names: dict[tuple[str, str], str] = {}  # by source and the gateway's Zenoh id
        self._busy: QueryError | None = None  # what a gateway said that gets too many queries

    def query(self, keys: list[str], source: str | None, *, fresh: bool) -> None:
        """Query ``keys``, and repeat those without a reply; raises QueryError when time is up."""
        unanswered = self._query_once(keys, fresh=fresh)
        while unanswered:
            left_s = self._limits.left_s
            if left_s == 0 or self._limits.discovery_is_over:
                self._require_gateway(source)
            if left_s == 0:
                raise self._busy or self._limits.no_reply(", ".join(unanswered))
            time.sleep(min(RETRY_S, left_s))
            unanswered = self._query_once(unanswered, fresh=fresh)

    def _query_once(self, keys: list[str], *, fresh: bool) -> list[str]:
        """Query ``keys`` and return those without any reply, as happens while Zenoh reconnects.

        That a gateway gets too many queries is no reply either.
        """
        options = "?fresh=true" if fresh else ""
        handlers = {
            # NONE keeps the replies of all gateways: several may serve sources of the same name.
            key: self._session.get(
                key + options,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=max(0.1, self._limits.left_s),
            )
            for key in keys
        }
        return [key for key, handler in handlers.items() if not self._receive(handler)]

    def _receive(self, handler: zenoh.handlers.Handler[zenoh.Reply]) -> bool:
        """Add the replies to one query; return whether there was any."""
        is_answered = False
        for reply in handler:
            if reply.ok is not None:
                self._replies.received.append(self._parameters_reply(reply.ok, str(reply.replier_id)))
            elif reply.err is not None:
                problem = self._problem(reply.err)
                if problem.code in BUSY_CODES:
                    self._busy = problem
                    continue
                self._replies.problems.append(problem)
            is_answered = True
        return is_answered

    def _parameters_reply(self, sample: zenoh.Sample, gateway: str) -> ParametersReply:
        source, _, *sections = str(sample.key_expr).removeprefix(f"{self._prefix}/").split("/")
        if (source, gateway) not in self._unique_names:
            self._unique_names[source, gateway] = unique_name(source, set(self._unique_names.values()))
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        name = self._unique_names[source, gateway]
        return ParametersReply(name, tuple(sections), sample.payload.to_bytes(), _age_s(attachment))

    def _problem(self, reply: zenoh.ReplyError) -> QueryError:
        text = reply.payload.to_bytes().decode("utf-8", "replace")
        media_type, _, code = str(reply.encoding).partition(";")
        if media_type == TEXT and code:
            return QueryError(text, code=code)
        # Any other error is Zenoh's own. "Timeout" means that a gateway received the query and did not reply.
        if text == "Timeout":
            return self._limits.no_reply("the parameters")
        return QueryError(f"Zenoh: {text}", code="zenoh")

    def _require_gateway(self, source: str | None) -> None:
        """Raise QueryError unless the liveliness token of a gateway that serves ``source`` is found."""
        tokens = self._session.liveliness().get(zenoh_key(self._prefix, "*", "alive"), timeout=1.0)
        keys = [str(reply.ok.key_expr) for reply in tokens if reply.ok is not None]
        served = sorted({key.removeprefix(f"{self._prefix}/").partition("/")[0] for key in keys})
        if not served:
            raise QueryError(
                f"no gateway found on Zenoh ({self._prefix}/*/alive); check that it is running with this "
                "prefix, and that --connect (or, without it, multicast) reaches the gateway or its router",
                code="no-gateway",
            )
        if source is not None and source not in served:
            raise QueryError(
                f"no gateway serves source {source!r}; sources found: {', '.join(served)}", code="no-gateway"
            )


def _age_s(attachment: bytes) -> float | None:
    with contextlib.suppress(ValueError, TypeError, KeyError):
        return float(json.loads(attachment)["age_s"])
    return None
