"""Queries from Zenoh and their replies, and the parameters and files that the gateway publishes.

If a handler fails or does not reply, the peer cannot distinguish that from a gateway that is not running. So
every query gets a reply, which is an error if there is no answer.
"""

import asyncio
import contextlib
import functools
import logging
import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import zenoh
import zenoh.ext

from gateway.errors import QueryError
from gateway.log import log_fields
from gateway.losses import Losses
from gateway.messages.topics import zenoh_key
from gateway.outputs.contract import Answer, KeyPath, QueryService, ServerParameters
from gateway.outputs.encodings import JSON, TEXT, XML, json_bytes
from gateway.outputs.zenoh.config import zenoh_reason
from gateway.outputs.zenoh.send_thread import SendThread

MAX_PENDING: Final = 4096
"""The maximum number of queries in progress. Further ones get the error busy."""

LONG_ANSWER_BYTES: Final = 1024 * 1024
"""A second thread sends longer answers (C3D files), so that other answers need not wait."""

# Parameters must arrive, even if that takes longer, and messages of streams have priority.
_RELIABLE: Final = zenoh.CongestionControl.BLOCK
_LOW_PRIORITY: Final = zenoh.Priority.DATA_LOW

_OVERTAKING_S: Final = 0.05
"""For how long messages of streams could overtake parameters, because of their priority.

With 1000 messages per second on a busy computer, they did so for up to 7 ms after 2 of 80 publications.
"""

logger = logging.getLogger(__name__)


_AnyPublisher = zenoh.ext.AdvancedPublisher | zenoh.Publisher


class _Declared(NamedTuple):
    """What is declared on the session for one source."""

    queryable: zenoh.Queryable[None]
    publisher: _AnyPublisher
    subscriber_watch: zenoh.Publisher


class ZenohQueries:
    """Answers queries below PREFIX/SOURCE/ with ``service``, through one queryable per source.

    ``open`` may be called in any thread; everything else runs in ``loop``.
    """

    def __init__(self, prefix: str, service: QueryService, loop: asyncio.AbstractEventLoop) -> None:
        self._prefix = prefix
        self._service = service
        self._loop = loop
        self._lock = threading.Lock()  # of _session and _declared, shared with the thread that opens
        self._session: zenoh.Session | None = None
        self._declared: dict[str, _Declared] = {}  # by the source's name
        self._parameters: dict[str, ServerParameters] = {}
        self._losses: defaultdict[str, Losses] = defaultdict(lambda: Losses(logger, "zenoh"))  # by source
        self._tasks: set[asyncio.Task[None]] = set()
        # Sending to a peer that has stopped reading blocks for 5 s, until Zenoh closes the link. So a thread
        # sends. There is only one for short answers: two threads that block stop all of Zenoh meanwhile.
        self._sender = SendThread("zenoh-send")
        self._long_sender = SendThread("zenoh-send-long")
        self._is_closed = False
        self.results: Counter[str] = Counter()
        """Queries by result: ok, or the code of the error."""

    def open(self, session: zenoh.Session, sources: Sequence[str]) -> None:
        """Declare the queryables and publishers of ``sources`` on an open session."""
        with self._lock:
            self._session = session
            self._declared = {source: self._declare(session, source) for source in sources}
        self._call_in_loop(self._publish_all)

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` what is lost of ``source``: queries, parameters and announcements."""
        self._losses[source] = losses

    def add(self, source: str) -> None:
        """Answer queries about one more source."""
        with self._lock:
            if self._session is not None and source not in self._declared:
                self._declared[source] = self._declare(self._session, source)

    def remove(self, source: str) -> None:
        """Stop answering queries about a source."""
        self._parameters.pop(source, None)
        with self._lock:
            declared = self._declared.pop(source, None)
        if declared is not None:
            declared.queryable.undeclare()
            declared.subscriber_watch.undeclare()
            # The thread may be sending on this one, and Zenoh refuses to undeclare it meanwhile.
            self._sender.submit(declared.publisher.undeclare)

    def _declare(self, session: zenoh.Session, source: str) -> _Declared:
        key = zenoh_key(self._prefix, source)

        def on_query(query: zenoh.Query) -> None:
            self._call_in_loop(self._start_answer, source, query)

        def on_matching(status: zenoh.MatchingStatus) -> None:
            if status.matching:
                self._call_in_loop(self._publish_again, source)

        queryable = session.declare_queryable(f"{key}/**", on_query)
        publisher = _parameters_publisher(session, f"{key}/parameters")
        # An AdvancedPublisher does not report its subscribers, so a plain publisher on the same key does.
        # Otherwise plain subscribers that connect late would have to wait for the next change.
        subscriber_watch = session.declare_publisher(f"{key}/parameters")
        subscriber_watch.declare_matching_listener(on_matching)
        return _Declared(queryable, publisher, subscriber_watch)

    def _call_in_loop(self, call: Callable[..., object], *arguments: Any) -> None:
        """Call ``call`` in the event loop, from one of Zenoh's threads."""
        with contextlib.suppress(RuntimeError):  # the loop has just ended
            self._loop.call_soon_threadsafe(call, *arguments)

    # Parameters and files.

    def publish_parameters(self, source: str, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """Publish a source's parameters as the server sent them.

        Returns a future that is done when messages can no longer overtake them; None while the session is
        not open.
        """
        self._parameters[source] = parameters
        sent = self._publish_again(source)
        if sent is None:
            return None
        arrived = self._loop.create_future()
        sent.add_done_callback(lambda _: self._loop.call_later(_OVERTAKING_S, _set_done, arrived))
        return arrived

    def _publish_all(self) -> None:
        for source in self._parameters:
            self._publish_again(source)

    def _publish_again(self, source: str) -> asyncio.Future[None] | None:
        declared = self._declared.get(source)
        parameters = self._parameters.get(source)
        if declared is not None and parameters is not None:
            attachment = {"session": parameters.session, "parameters_version": parameters.version}
            put = functools.partial(declared.publisher.put, attachment=json_bytes(attachment))
            return self._send(source, put, parameters.xml)
        return None

    def announce_file(self, source: str, description: Mapping[str, Any]) -> None:
        """Announce a C3D file on the key that returns it."""
        if self._session is not None:
            key = zenoh_key(self._prefix, source, "c3d")
            put = functools.partial(
                self._session.put, encoding=JSON, congestion_control=_RELIABLE, priority=_LOW_PRIORITY
            )
            self._send(source, put, key, json_bytes(description))

    def _send(self, source: str, put: Callable[..., None], *arguments: Any) -> asyncio.Future[None] | None:
        if self._is_closed:
            return None
        put = functools.partial(self._put, source, put, *arguments)
        return asyncio.wrap_future(self._sender.submit(put), loop=self._loop)

    def _put(self, source: str, put: Callable[..., None], *arguments: Any) -> None:
        """Publish, in the sending thread."""
        try:
            put(*arguments)
        except zenoh.ZError as error:
            if not self._is_closed:
                text = f"Zenoh did not take parameters or an announcement: {zenoh_reason(error)}"
                self._losses[source].lost("put failed", text, frames=0)

    # Queries.

    def _start_answer(self, source: str, query: zenoh.Query) -> None:
        if self._is_closed or not self._service.serves(source):
            query.drop()
            return
        if len(self._tasks) >= MAX_PENDING:
            error = QueryError("the gateway has too many queries; try again", code="busy")
            text = f"a query is refused as busy, because {MAX_PENDING} others are in progress; ask less often"
            self._losses[source].lost("query beyond the queue", text, frames=0)
            self._sender.submit(functools.partial(_reply_error, query, error))
            self.results[error.code] += 1
            return
        with log_fields(source=source):
            task = asyncio.create_task(self._answer(source, query))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _answer(self, source: str, query: zenoh.Query) -> None:
        try:
            answers = await self._answers(source, query)
        except QueryError as error:
            await self._refuse(query, error)
        except Exception as error:
            logger.exception("%s: query %s", source, query.selector)
            await self._refuse(query, QueryError(f"a defect in the gateway: {error!r}", code="defect"))
        else:
            is_long = any(len(answer.payload) > LONG_ANSWER_BYTES for answer in answers.values())
            sender = self._long_sender if is_long else self._sender
            await asyncio.wrap_future(sender.submit(functools.partial(_reply, query, answers)))
            self.results["ok"] += 1

    async def _refuse(self, query: zenoh.Query, error: QueryError) -> None:
        await asyncio.wrap_future(self._sender.submit(functools.partial(_reply_error, query, error)))
        self.results[error.code] += 1

    async def _answers(self, source: str, query: zenoh.Query) -> dict[str, Answer]:
        """Return the answers by key. Raises QueryError if there is none."""
        base = zenoh_key(self._prefix, source) + "/"
        selected, options = str(query.key_expr), _options(query)
        if "*" not in selected and selected.startswith(base):
            path = tuple(selected.removeprefix(base).split("/"))
            return {selected: await self._service.answer(source, path, options)}
        paths = self._matching(query.key_expr, base, source)
        if not paths:
            raise QueryError(self._nothing_matches(selected, base, source))
        answers = await self._service.answer_all(source, paths, options)
        return {base + "/".join(path): answer for path, answer in answers.items()}

    def _matching(self, selected: zenoh.KeyExpr, base: str, source: str) -> list[KeyPath]:
        """Return the keys of the source that a selector with wildcards matches.

        A C3D file may have hundreds of MB, so it is selected only by its name, as in mocap/*/c3d.
        """
        last = str(selected).rpartition("/")[2]
        return [
            path
            for path in self._service.keys(source)
            if (path != ("c3d",) or last == "c3d")
            and selected.intersects(zenoh.KeyExpr(base + "/".join(path)))
        ]

    def _nothing_matches(self, selected: str, base: str, source: str) -> str:
        if selected.rpartition("/")[2] == "recording":
            return f"recording is controlled for one source at a time; accepted: {base}recording"
        accepted = self._service.accepted_keys(source)
        return f"nothing of source {source!r} matches {selected}; accepted below {base}: {accepted}"

    async def close(self) -> None:
        """Drop the pending queries. Their peers see at once that no reply follows."""
        self._is_closed = True
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for sender in (self._sender, self._long_sender):
            sender.close()


def _parameters_publisher(session: zenoh.Session, key: str) -> _AnyPublisher:
    try:
        return zenoh.ext.declare_advanced_publisher(
            session,
            key,
            encoding=XML,
            # The cache serves late AdvancedSubscribers, so that they need not query.
            cache=zenoh.ext.CacheConfig(max_samples=1),
            publisher_detection=True,
            congestion_control=_RELIABLE,
            priority=_LOW_PRIORITY,
        )
    except zenoh.ZError as error:
        logger.warning(
            "zenoh: late subscribers have to query %s themselves: %s; "
            "set timestamping: {enabled: true} in Zenoh's configuration file",
            *(key, zenoh_reason(error)),
        )
        return session.declare_publisher(
            key, encoding=XML, congestion_control=_RELIABLE, priority=_LOW_PRIORITY
        )


def _set_done(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)


# These functions may block, so they run in a SendThread.


def _reply(query: zenoh.Query, answers: Mapping[str, Answer]) -> None:
    with query:
        try:
            for key, answer in answers.items():
                attachment = json_bytes(answer.attachment) if answer.attachment else None
                query.reply(key, answer.payload, encoding=answer.encoding, attachment=attachment)
        except zenoh.ZError as error:
            logger.debug("zenoh: replying to %s: %s", query.selector, error)


def _reply_error(query: zenoh.Query, error: QueryError) -> None:
    """Reply with an error. The schema of the encoding is the error's code."""
    with query:
        try:
            query.reply_err(str(error), encoding=zenoh.Encoding(TEXT).with_schema(error.code))
        except zenoh.ZError as problem:
            logger.debug("zenoh: replying to %s: %s", query.selector, problem)


def _options(query: zenoh.Query) -> dict[str, str]:
    """Return the selector's options; names that start with _ are Zenoh's own."""
    options = {}
    for pair in filter(None, str(query.parameters).split(";")):
        name, _, value = pair.partition("=")
        if not name.startswith("_"):
            options[name] = value
    return options
