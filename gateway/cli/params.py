"""``rtc3d-gateway params``: ask gateways for the parameters of their servers, on Zenoh or on LCM."""

import contextlib
import json
import re
import threading
import time
import uuid
from typing import Any, Final, NamedTuple

import rtc3d
import zenoh

from gateway.cli.params_tables import Sections, Told
from gateway.cli.subscribers import LcmListener, open_zenoh
from gateway.config.settings import lcm_queries_url
from gateway.errors import OutputError, ProtocolError, QueryError
from gateway.messages.decode import decode
from gateway.messages.topics import lcm_channel, unique_name, zenoh_key
from gateway.outputs.lcm.output import open_lcm
from gateway.queries.answers import TEXT

EXIT_STATUSES: Final = {"no-gateway": 3, "no-connection": 4, "timeout": 5}
"""What the command ends with by the code of its first problem; 1 for others."""

_LOOK_S: Final = 2.5
"""How long to look for a gateway: links take their time, and on LCM a status comes once a second."""
_AGAIN_S: Final = 0.5
_POLL_S: Final = 0.02


class Outcome(NamedTuple):
    """What came, and what did not. The problems' codes are those of QueryError, and no-gateway."""

    told: list[Told]
    problems: list[QueryError]


class _Patience:
    """How long is waited for a gateway, and for answers."""

    def __init__(self, timeout_s: float) -> None:
        start_s = time.monotonic()
        self.timeout_s = timeout_s
        self._end_s = start_s + timeout_s
        self._looked_s = start_s + _LOOK_S

    @property
    def left_s(self) -> float:
        return max(0.0, self._end_s - time.monotonic())

    @property
    def has_looked(self) -> bool:
        """Whether a gateway would have been noticed if it were there."""
        return time.monotonic() >= self._looked_s

    def no_answer(self, what: str) -> QueryError:
        return QueryError(
            f"no answer about {what} within {self.timeout_s:g} s, though a gateway is there; "
            "try again, or with a longer --timeout",
            code="timeout",
        )


def ask_zenoh(
    prefix: str, source: str | None, sections: Sections, *, fresh: bool, connect: str | None, timeout_s: float
) -> Outcome:
    """Ask for each section by itself: the gateways that serve ``source``, or all of them."""
    outcome = Outcome([], [])
    try:
        session = open_zenoh(connect)
    except OutputError as error:
        outcome.problems.append(QueryError(str(error), code="no-gateway"))
        return outcome
    key = zenoh_key(prefix, source or "*") + "/parameters"
    asker = _ZenohAsker(session, prefix, outcome)
    patience = _Patience(timeout_s)
    try:
        unanswered = asker.ask([f"{key}/{section}" for section in sections] or [key], fresh, patience)
        while unanswered:
            if patience.has_looked or patience.left_s == 0:
                asker.require_gateway(source)
            if patience.left_s == 0:
                raise patience.no_answer(", ".join(unanswered))
            time.sleep(min(_AGAIN_S, patience.left_s))
            unanswered = asker.ask(unanswered, fresh, patience)
    except QueryError as error:
        outcome.problems.append(error)
    finally:
        session.close()
    return outcome


class _ZenohAsker:
    """Puts into ``outcome`` what comes over a session."""

    def __init__(self, session: zenoh.Session, prefix: str, outcome: Outcome) -> None:
        self._session = session
        self._prefix = prefix
        self._outcome = outcome
        self._names: dict[tuple[str, str], str] = {}  # by the source's and its gateway's

    def ask(self, keys: list[str], fresh: bool, patience: _Patience) -> list[str]:
        """Ask once; return the keys to which nobody said anything, as happens around a reconnection."""
        options = "?fresh=true" if fresh else ""
        # Several gateways may serve a source of the same name: no answer replaces another.
        asked = {
            key: self._session.get(
                key + options, consolidation=zenoh.ConsolidationMode.NONE, timeout=max(0.1, patience.left_s)
            )
            for key in keys
        }
        return [key for key, replies in asked.items() if not self._take(replies, patience)]

    def _take(self, replies: zenoh.handlers.Handler[zenoh.Reply], patience: _Patience) -> bool:
        came = False
        for reply in replies:
            came = True
            if reply.ok is not None:
                self._outcome.told.append(self._told(reply.ok, str(reply.replier_id)))
            elif reply.err is not None:
                self._outcome.problems.append(_zenoh_problem(reply.err, patience))
        return came

    def _told(self, sample: zenoh.Sample, gateway: str) -> Told:
        source, _, *sections = str(sample.key_expr).removeprefix(f"{self._prefix}/").split("/")
        if (source, gateway) not in self._names:
            self._names[source, gateway] = unique_name(source, set(self._names.values()))
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        return Told(
            self._names[source, gateway], tuple(sections), sample.payload.to_bytes(), _age_s(attachment)
        )

    def require_gateway(self, source: str | None) -> None:
        """Raise QueryError unless a gateway shows that it is there and serves ``source``."""
        tokens = self._session.liveliness().get(zenoh_key(self._prefix, "*", "alive"), timeout=1.0)
        keys = [str(reply.ok.key_expr) for reply in tokens if reply.ok is not None]
        served = sorted({key.removeprefix(f"{self._prefix}/").partition("/")[0] for key in keys})
        if not served:
            raise QueryError(
                f"no gateway is there on Zenoh ({self._prefix}/*/alive): is it running, has it this prefix, "
                "and does --connect, or multicast without it, lead to it or to its router?",
                code="no-gateway",
            )
        if source is not None and source not in served:
            raise QueryError(
                f"no gateway serves source {source!r}; there are: {', '.join(served)}", code="no-gateway"
            )


def _zenoh_problem(reply: zenoh.ReplyError, patience: _Patience) -> QueryError:
    text = reply.payload.to_bytes().decode("utf-8", "replace")
    kind, _, code = str(reply.encoding).partition(";")
    if kind == TEXT and code:
        return QueryError(text, code=code)
    # Zenoh's own: a gateway was asked and said nothing.
    return (
        patience.no_answer("the parameters")
        if text == "Timeout"
        else QueryError(f"Zenoh: {text}", code="zenoh")
    )


def _age_s(attachment: bytes) -> float | None:
    with contextlib.suppress(ValueError, TypeError, KeyError):
        return float(json.loads(attachment)["age_s"])
    return None


def ask_lcm(
    prefix: str,
    source: str | None,
    sections: Sections,
    *,
    fresh: bool,
    url: str,
    queries_url: str | None = None,
    timeout_s: float,
) -> Outcome:
    """Ask for all sections at once: the gateway of ``source``, or of every source that is heard of.

    Sources are heard of on ``url`` and asked on ``queries_url``, by default the one that belongs to it.
    Raises OutputError if LCM does not open or does not send.
    """
    outcome = Outcome([], [])
    queries_url = queries_url or lcm_queries_url(url)
    asker = _LcmAsker(url, queries_url, prefix, sections, fresh=fresh)
    try:
        patience = _Patience(timeout_s)
        while source is None and not patience.has_looked:
            time.sleep(_POLL_S)
        sources = sorted(asker.heard.copy()) if source is None else [source]
        if not sources:
            outcome.problems.append(_nobody_on_lcm(prefix, url))
        patience = _Patience(timeout_s)
        try:
            asker.ask(sources, patience)
        except OSError as error:
            raise OutputError(
                f"LCM did not send to {url}: {error}; check --url", cause="send failed"
            ) from error
        for each in sources:
            reply = asker.replies.get(each)
            if reply is None and each in asker.heard:
                outcome.problems.append(patience.no_answer(f"source {each!r}"))
            elif reply is None:
                outcome.problems.append(_nobody_on_lcm(lcm_channel(prefix, each), url))
            elif reply.error:
                outcome.problems.append(QueryError(reply.error, code=reply.error_code))
            else:
                outcome.told.append(Told(each, sections, reply.xml.encode(), reply.age_s))
    finally:
        asker.close()
    return outcome


class _LcmAsker:
    """Sends requests, and hears replies and who is there."""

    def __init__(self, url: str, queries_url: str, prefix: str, sections: Sections, *, fresh: bool) -> None:
        self._lcm = open_lcm(queries_url)
        self._prefix = prefix
        self._request = rtc3d.parameters_request_t()
        self._request.requester = f"rtc3d-gateway params {uuid.uuid4()}"
        self._request.sections, self._request.num_sections = list(sections), len(sections)
        self._request.fresh = fresh
        self._asked: dict[int, str] = {}
        self.heard: set[str] = set()
        """Sources of which a status came."""
        self.replies: dict[str, Any] = {}
        """``parameters_reply_t`` by source."""
        self._all_came = threading.Event()
        channels = f"{re.escape(prefix)}_.+_"
        self._listeners = [
            LcmListener(self._lcm, f"{channels}PARAMETERS_REPLY", self._take),
            LcmListener(open_lcm(url), f"{channels}STATUS", self._take),
        ]

    def _take(self, _channel: str, data: bytes) -> None:
        try:
            message = decode(data)
        except ProtocolError:
            return
        match message:
            case rtc3d.status_t():
                self.heard.add(message.source)
            case rtc3d.parameters_reply_t() if message.requester == self._request.requester:
                if message.request_id in self._asked:
                    self.replies.setdefault(self._asked[message.request_id], message)
                if len(self.replies) == len(self._asked):
                    self._all_came.set()

    def ask(self, sources: list[str], patience: _Patience) -> None:
        """Ask the sources, again and again while they do not answer."""
        self._asked = dict(enumerate(sources))
        while sources and not self._all_came.is_set():
            for request_id, source in self._asked.items():
                if source not in self.replies:
                    self._request.request_id = request_id
                    channel = lcm_channel(self._prefix, source, "PARAMETERS_REQUEST")
                    self._lcm.publish(channel, self._request.encode())
            # Nobody heard of yet may be nobody there: that is worth the time until a status.
            may_come = patience.left_s or (not self.heard and not patience.has_looked)
            if not may_come:
                return
            self._all_came.wait(min(_AGAIN_S, patience.left_s or _AGAIN_S))

    def close(self) -> None:
        for listener in self._listeners:
            listener.close()


def _nobody_on_lcm(name: str, url: str) -> QueryError:
    return QueryError(
        f"no gateway is heard on LCM ({name}, {url}): is it running, has it this prefix and URL, "
        "and does its ttl reach this computer?",
        code="no-gateway",
    )
