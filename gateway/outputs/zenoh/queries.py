"""Questions that come on Zenoh, one queryable per source; and parameters and files told unasked.

A handler that fails, or says nothing, looks to the asker as if nobody were there: every query is
replied to, with an error where there is no answer.
"""

import asyncio
import contextlib
import functools
import logging
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import zenoh
import zenoh.ext

from gateway.config.values import zenoh_reason
from gateway.errors import QueryError
from gateway.log import log_fields
from gateway.messages.topics import zenoh_key
from gateway.outputs.zenoh.send_thread import SendThread
from gateway.queries.answers import (
    JSON,
    TEXT,
    XML,
    Answer,
    Parts,
    accepted_keys,
    json_bytes,
    known_keys,
    parse_question,
    parse_questions,
)
from gateway.queries.source_queries import SourceQueries

MAX_PENDING: Final = 4096
"""How many queries are worked on at once; the next is told to come again."""

LONG_ANSWER_BYTES: Final = 1024 * 1024
"""Longer ones, C3D files that is, are sent by a thread of their own: others need not wait for them."""

# What is told must arrive, and may wait for it, behind the streams.
_ARRIVING: Final = zenoh.CongestionControl.BLOCK
_BEHIND: Final = zenoh.Priority.DATA_LOW

logger = logging.getLogger(__name__)


_AnyPublisher = zenoh.ext.AdvancedPublisher | zenoh.Publisher


class _Declared(NamedTuple):
    """What there is on a session for one source."""

    queryable: zenoh.Queryable[None]
    publisher: _AnyPublisher
    watcher: zenoh.Publisher


class ZenohQueries:
    """Answers for all ``desks``, by the source's name, below ``prefix``.

    The desks may change: ``serve`` and ``dismiss`` tell of one that came or went. ``declare`` is called,
    from any thread, with the session once it opens; everything else runs in the loop that is current when
    the object is made.
    """

    def __init__(self, prefix: str, desks: Mapping[str, SourceQueries]) -> None:
        self._prefix = prefix
        self._desks = desks
        self._loop = asyncio.get_running_loop()
        self._lock = threading.Lock()  # of _session and _declared, shared with the thread that opens
        self._session: zenoh.Session | None = None
        self._declared: dict[str, _Declared] = {}  # by the source's name
        self._newest_xml: dict[str, bytes] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        # To a peer that has stopped reading, sending blocks for 5 s, until Zenoh closes the link. So it
        # is done in a thread, and in no more than one: two that block there stop all of Zenoh meanwhile.
        self._sender = SendThread("zenoh-send")
        self._long_sender = SendThread("zenoh-send-long")
        self._closed = False
        self.results: Counter[str] = Counter()
        """Queries by result: ok, or the code of the error."""

    def declare(self, session: zenoh.Session) -> None:
        """Make the queryables and publishers on an open session; they live as long as it does."""
        with self._lock:
            self._session = session
            self._declared = {source: self._declare(session, source) for source in list(self._desks)}
        self._hop(self._tell_all_again)

    def _declare(self, session: zenoh.Session, source: str) -> _Declared:
        key = zenoh_key(self._prefix, source)

        def on_query(query: zenoh.Query) -> None:
            self._hop(self._take, source, query)

        def on_matching(status: zenoh.MatchingStatus) -> None:
            if status.matching:
                self._hop(self._tell_again, source)

        queryable = session.declare_queryable(f"{key}/**", on_query)
        publisher = _parameters_publisher(session, f"{key}/parameters")
        # An AdvancedPublisher does not say who listens. Subscribers without a history, whose link
        # comes after the parameters, would wait for the next change.
        watcher = session.declare_publisher(f"{key}/parameters")
        watcher.declare_matching_listener(on_matching)
        return _Declared(queryable, publisher, watcher)

    def serve(self, source: str) -> None:
        """Begin to answer for a source whose desk has come."""
        with self._lock:
            if self._session is not None and source not in self._declared:
                self._declared[source] = self._declare(self._session, source)

    def dismiss(self, source: str) -> None:
        """Answer no longer for a source whose desk has gone."""
        self._newest_xml.pop(source, None)
        with self._lock:
            declared = self._declared.pop(source, None)
        if declared is not None:
            declared.queryable.undeclare()
            declared.publisher.undeclare()  # type: ignore[no-untyped-call] # Zenoh's stub has no types here
            declared.watcher.undeclare()

    def _hop(self, call: Callable[..., None], *arguments: Any) -> None:
        """Call in the loop, from one of Zenoh's threads: nothing else may be done there."""
        with contextlib.suppress(RuntimeError):  # the loop has just ended
            self._loop.call_soon_threadsafe(call, *arguments)

    def tell_parameters(self, source: str, xml: bytes) -> None:
        """Publish a source's parameters, as the server sent them."""
        self._newest_xml[source] = xml
        self._tell_again(source)

    def _tell_all_again(self) -> None:
        for source in self._newest_xml:
            self._tell_again(source)

    def _tell_again(self, source: str) -> None:
        declared = self._declared.get(source)
        if declared is not None and source in self._newest_xml:
            self._tell(declared.publisher.put, self._newest_xml[source])

    def tell_file(self, source: str, description: Mapping[str, Any]) -> None:
        """Announce a C3D file on the key on which it can be asked for."""
        if self._session is not None:
            key = zenoh_key(self._prefix, source, "c3d")
            put = functools.partial(
                self._session.put, encoding=JSON, congestion_control=_ARRIVING, priority=_BEHIND
            )
            self._tell(put, key, json_bytes(description))

    def _tell(self, put: Callable[..., None], *arguments: Any) -> None:
        if not self._closed:
            self._sender.submit(functools.partial(_guarded, put, *arguments))

    async def close(self) -> None:
        """Give up the queries under way; their askers see no reply at once."""
        self._closed = True
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for sender in (self._sender, self._long_sender):
            sender.close()

    def _take(self, source: str, query: zenoh.Query) -> None:
        desk = self._desks.get(source)
        if self._closed or desk is None:
            query.drop()
            return
        if len(self._tasks) >= MAX_PENDING:
            error = QueryError("the gateway has too many queries; try again", code="busy")
            self._sender.submit(functools.partial(_refuse, query, error))
            self.results[error.code] += 1
            return
        with log_fields(source=desk.source.name):
            task = asyncio.create_task(self._answer(desk, query))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _answer(self, desk: SourceQueries, query: zenoh.Query) -> None:
        try:
            answers = await self._answers(desk, query)
        except QueryError as error:
            await self._refuse(query, error)
        except Exception as error:
            logger.exception("%s: query %s", desk.source.name, query.selector)
            await self._refuse(query, QueryError(f"a defect in the gateway: {error!r}", code="defect"))
        else:
            is_long = any(len(answer.payload) > LONG_ANSWER_BYTES for answer in answers.values())
            sender = self._long_sender if is_long else self._sender
            await asyncio.wrap_future(sender.submit(functools.partial(_give, query, answers)))
            self.results["ok"] += 1

    async def _refuse(self, query: zenoh.Query, error: QueryError) -> None:
        await asyncio.wrap_future(self._sender.submit(functools.partial(_refuse, query, error)))
        self.results[error.code] += 1

    async def _answers(self, desk: SourceQueries, query: zenoh.Query) -> dict[str, Answer]:
        """Return the answers by key; raises QueryError if there is none."""
        own = zenoh_key(self._prefix, desk.source.name) + "/"
        asked, options = str(query.key_expr), _options(query)
        if "*" not in asked and asked.startswith(own):
            parts = tuple(asked.removeprefix(own).split("/"))
            return {asked: await desk.answer(parse_question(parts, options, desk.components))}
        keys = _matching(query.key_expr, own, desk)
        if not keys:
            raise QueryError(_nothing_matches(asked, own, desk))
        questions = parse_questions(keys, options, desk.components)
        found = await asyncio.gather(*map(desk.answer, questions.values()), return_exceptions=True)
        answers: dict[str, Answer] = {}
        problem: BaseException | None = None
        for parts, each in zip(questions, found, strict=True):
            if isinstance(each, Answer):
                answers[own + "/".join(parts)] = each
            elif problem is None or not isinstance(each, QueryError):
                problem = each
        if problem is not None and (not answers or not isinstance(problem, QueryError)):
            raise problem
        return answers


def _parameters_publisher(session: zenoh.Session, key: str) -> _AnyPublisher:
    try:
        return zenoh.ext.declare_advanced_publisher(
            session,
            key,
            encoding=XML,
            # The cache answers subscribers that come late; they need not ask.
            cache=zenoh.ext.CacheConfig(max_samples=1),
            publisher_detection=True,
            congestion_control=_ARRIVING,
            priority=_BEHIND,
        )
    except zenoh.ZError as error:
        logger.warning(
            "zenoh: subscribers that come late must ask for %s themselves: %s; "
            "set timestamping: {enabled: true} in Zenoh's configuration file",
            *(key, zenoh_reason(error)),
        )
        return session.declare_publisher(key, encoding=XML, congestion_control=_ARRIVING, priority=_BEHIND)


def _guarded(put: Callable[..., None], *arguments: Any) -> None:
    try:
        put(*arguments)
    except zenoh.ZError as error:
        logger.debug("zenoh: not told: %s", error)


def _give(query: zenoh.Query, answers: Mapping[str, Answer]) -> None:
    """Reply; in a thread, for it may take long."""
    with query:
        try:
            for key, answer in answers.items():
                attachment = json_bytes(answer.attachment) if answer.attachment else None
                query.reply(key, answer.payload, encoding=answer.encoding, attachment=attachment)
        except zenoh.ZError as error:
            logger.debug("zenoh: replying to %s: %s", query.selector, error)


def _refuse(query: zenoh.Query, error: QueryError) -> None:
    """Reply with an error, its code as the encoding's schema; in a thread, for it may take long."""
    with query:
        try:
            query.reply_err(str(error), encoding=zenoh.Encoding(TEXT).with_schema(error.code))
        except zenoh.ZError as problem:
            logger.debug("zenoh: replying to %s: %s", query.selector, problem)


def _options(query: zenoh.Query) -> dict[str, str]:
    """Return the selector's options; names that begin with _ are Zenoh's own."""
    options = {}
    for pair in filter(None, str(query.parameters).split(";")):
        name, _, value = pair.partition("=")
        if not name.startswith("_"):
            options[name] = value
    return options


def _matching(asked: zenoh.KeyExpr, own: str, desk: SourceQueries) -> list[Parts]:
    """Return the keys of the source that a selector with wildcards asks of.

    A file of hundreds of MB is only for those who name it, as in mocap/*/c3d, and nobody shall start a
    recording by a wildcard.
    """
    named = str(asked).rpartition("/")[2]
    return [
        parts
        for parts in known_keys(desk.components)
        if parts != ("recording",)
        and (parts != ("c3d",) or named == "c3d")
        and asked.intersects(zenoh.KeyExpr(own + "/".join(parts)))
    ]


def _nothing_matches(asked: str, own: str, desk: SourceQueries) -> str:
    if asked.rpartition("/")[2] == "recording":
        return f"recording is controlled for one source at a time; accepted: {own}recording"
    return (
        f"nothing of source {desk.source.name!r} matches {asked}; "
        f"accepted below {own}: {accepted_keys(desk.components)}"
    )
