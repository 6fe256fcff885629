"""Questions that come on Zenoh, one queryable per source; and parameters and files told unasked.

A handler that fails, or says nothing, looks to the asker as if nobody were there: every query is
replied to, with an error where there is no answer.
"""

import asyncio
import contextlib
import logging
from collections import Counter
from collections.abc import Mapping
from typing import Any, Final

import zenoh
import zenoh.ext

from gateway.errors import QueryError
from gateway.names import zenoh_key
from gateway.queries.answers import (
    JSON,
    TEXT,
    XML,
    Answer,
    Parts,
    fitting_options,
    json_bytes,
    known_keys,
    parse_question,
)
from gateway.queries.desk import Desk

MAX_PENDING: Final = 4096
"""How many queries are worked on at once; the next is told to come again."""

logger = logging.getLogger(__name__)


class ZenohQueries:
    """Answers for all ``desks``, by the source's name, below ``prefix``.

    ``declare`` is called, from any thread, with each session that opens; everything else runs in the
    loop that is current when the object is made.
    """

    def __init__(self, prefix: str, desks: Mapping[str, Desk]) -> None:
        self._prefix = prefix
        self._desks = desks
        self._loop = asyncio.get_running_loop()
        self._session: zenoh.Session | None = None
        self._publishers: dict[str, zenoh.ext.AdvancedPublisher] = {}
        self._newest_xml: dict[str, bytes] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self.results: Counter[str] = Counter()
        """Queries by result: ok, or the code of the error."""

    def declare(self, session: zenoh.Session) -> None:
        """Make the queryables and publishers on an open session; they live as long as it does."""
        for source, desk in self._desks.items():
            key = zenoh_key(self._prefix, source)

            def on_query(query: zenoh.Query, desk: Desk = desk) -> None:
                # From Zenoh's thread: nothing but the hop. RuntimeError: the loop has just ended.
                with contextlib.suppress(RuntimeError):
                    self._loop.call_soon_threadsafe(self._take, desk, query)

            session.declare_queryable(f"{key}/**", on_query)
            self._publishers[source] = zenoh.ext.declare_advanced_publisher(
                session,
                f"{key}/parameters",
                encoding=XML,
                # The cache answers subscribers that come late; they need not ask.
                cache=zenoh.ext.CacheConfig(max_samples=1),
                publisher_detection=True,
            )
        self._session = session
        for source, xml in list(self._newest_xml.items()):
            self._publishers[source].put(xml)

    def tell_parameters(self, source: str, xml: bytes) -> None:
        """Publish a source's parameters, as the server sent them."""
        self._newest_xml[source] = xml
        if source in self._publishers:
            self._publishers[source].put(xml)

    def tell_file(self, source: str, description: Mapping[str, Any]) -> None:
        """Announce a C3D file on the key on which it can be asked for."""
        if self._session is not None:
            key = zenoh_key(self._prefix, source, "c3d")
            self._session.put(key, json_bytes(description), encoding=JSON)

    async def close(self) -> None:
        """Give up the queries under way; their askers see no reply at once."""
        self._session = None
        self._publishers.clear()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _take(self, desk: Desk, query: zenoh.Query) -> None:
        if len(self._tasks) >= MAX_PENDING:
            with query:
                self._refuse(query, QueryError("the gateway has too many queries; try again", code="busy"))
            return
        task = asyncio.create_task(self._answer(desk, query))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _answer(self, desk: Desk, query: zenoh.Query) -> None:
        with query:
            try:
                await self._reply(desk, query)
            except QueryError as error:
                self._refuse(query, error)
            except zenoh.ZError as error:
                logger.debug("%s: replying to %s: %s", desk.source.name, query.selector, error)
            except Exception as error:
                logger.exception("%s: query %s", desk.source.name, query.selector)
                self._refuse(query, QueryError(f"a defect in the gateway: {error!r}", code="defect"))

    async def _reply(self, desk: Desk, query: zenoh.Query) -> None:
        own = zenoh_key(self._prefix, desk.source.name) + "/"
        asked, options = str(query.key_expr), _options(query)
        if asked.startswith(own) and "*" not in asked:
            parts = tuple(asked.removeprefix(own).split("/"))
            self._give(query, asked, await desk.answer(parse_question(parts, options, desk.components)))
            return
        replies = 0
        problem = QueryError(f"nothing of source {desk.source.name!r} matches {asked}")
        for parts in _matching(query.key_expr, own, desk):
            try:
                question = parse_question(parts, fitting_options(parts, options), desk.components)
                answer = await desk.answer(question)
            except QueryError as error:
                problem = error
            else:
                self._give(query, own + "/".join(parts), answer)
                replies += 1
        if not replies:
            raise problem

    def _give(self, query: zenoh.Query, key: str, answer: Answer) -> None:
        attachment = json_bytes(answer.attachment) if answer.attachment else None
        query.reply(key, answer.payload, encoding=answer.encoding, attachment=attachment)
        self.results["ok"] += 1

    def _refuse(self, query: zenoh.Query, error: QueryError) -> None:
        self.results[error.code] += 1
        query.reply_err(str(error), encoding=zenoh.Encoding(TEXT).with_schema(error.code))


def _options(query: zenoh.Query) -> dict[str, str]:
    """Return the selector's options; names that begin with _ are Zenoh's own."""
    options = {}
    for pair in filter(None, str(query.parameters).split(";")):
        name, _, value = pair.partition("=")
        if not name.startswith("_"):
            options[name] = value
    return options


def _matching(asked: zenoh.KeyExpr, own: str, desk: Desk) -> list[Parts]:
    """Return the keys of the source that a selector with wildcards asks of.

    Recording control is not among them: nobody shall start it by a wildcard.
    """
    return [
        parts
        for parts in known_keys(desk.components)
        if parts != ("recording",) and asked.intersects(zenoh.KeyExpr(own + "/".join(parts)))
    ]
