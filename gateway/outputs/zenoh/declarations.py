"""What the gateway declares on Zenoh for each source besides its data: queries, parameters and files."""

import asyncio
import contextlib
import functools
import logging
import math
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any, Final, NamedTuple

import zenoh

from gateway.logs.losses import Losses
from gateway.messages.decode import JSON, XML, json_bytes
from gateway.messages.topics import zenoh_key
from gateway.outputs.contract import Answer, QueryService, ServerParameters
from gateway.outputs.zenoh.answers import ZenohAnswers
from gateway.outputs.zenoh.config import zenoh_reason
from gateway.outputs.zenoh.session import declare_publisher, in_zenoh_thread
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.workers import WorkerThread

# Parameters must arrive, even if that takes longer, and messages of streams have priority.
_RELIABLE: Final = zenoh.CongestionControl.BLOCK
_LOW_PRIORITY: Final = zenoh.Priority.DATA_LOW

_OVERTAKING_S: Final = 0.05
"""For how long messages of streams could overtake parameters, because of their priority.

With 1000 messages per second on a busy computer, they did so for up to 7 ms after 2 of 80 publications.
"""

_AGAIN_S: Final = 0.5
"""How long to wait at least before the parameters are published for a new subscriber again."""

logger = logging.getLogger(__name__)


class _Declared(NamedTuple):
    """What is declared on the session for one source."""

    queryable: zenoh.Queryable[None]
    publisher: zenoh.Publisher
    history: zenoh.Queryable[None]
    history_token: zenoh.LivelinessToken


class SourceDeclarations:
    """Answers queries below PREFIX/SOURCE/ with ``service``, and publishes parameters and files.

    There is one queryable for each source.

    ``open`` may be called in any thread; everything else runs in ``loop``.
    """

    def __init__(
        self, settings: ZenohSettings, service: QueryService, loop: asyncio.AbstractEventLoop
    ) -> None:
        self._prefix = settings.prefix
        self._loop = loop
        self._lock = threading.Lock()  # of what the thread that opens and Zenoh's threads share
        self._session: zenoh.Session | None = None
        self._declared: dict[str, _Declared] = {}  # by the source's name
        self._parameters: dict[str, ServerParameters] = {}
        self._unsent: dict[str, Future[None]] = {}  # publications of parameters that have not begun
        self._due: set[str] = set()  # sources whose parameters will be published for a new subscriber
        self._published_s: dict[str, float] = {}  # when that was done last
        self.losses: defaultdict[str, Losses] = defaultdict(lambda: Losses(logger, "zenoh"))
        """By source, what is lost: queries, parameters and announcements."""
        self._sender = WorkerThread("zenoh-send")
        self.answers = ZenohAnswers(settings, service, loop, self._sender, self.losses)
        self._is_closed = False

    def open(self, session: zenoh.Session, sources: Sequence[str]) -> None:
        """Declare the queryables and publishers of ``sources`` on an open session."""
        with self._lock:
            self._session = session
            self._declared = {source: self._declare(session, source) for source in sources}
        for source in sources:
            self._call_in_loop(self._publish_again, source)

    def add(self, source: str) -> None:
        """Answer queries about one more source."""
        with self._lock:
            if self._session is not None and source not in self._declared:
                self._declared[source] = self._declare(self._session, source)

    def remove(self, source: str) -> None:
        """Stop answering queries about a source."""
        with self._lock:
            self._parameters.pop(source, None)
            declared = self._declared.pop(source, None)
        if declared is not None:
            declared.history_token.undeclare()
            declared.history.undeclare()
            declared.queryable.undeclare()
            # The thread may be sending on this one, and Zenoh refuses to undeclare it meanwhile.
            self._sender.submit(declared.publisher.undeclare)

    def _declare(self, session: zenoh.Session, source: str) -> _Declared:
        key = zenoh_key(self._prefix, source)

        def on_matching(is_matched: bool) -> None:
            if is_matched:
                self._call_in_loop(self._publish_soon, source)

        on_query = in_zenoh_thread(functools.partial(self.answers.receive, source))
        queryable = session.declare_queryable(f"{key}/**", on_query)
        parameters = f"{key}/parameters"
        publisher = declare_publisher(
            *(session, parameters, on_matching),
            encoding=XML,
            congestion_control=_RELIABLE,
            priority=_LOW_PRIORITY,
        )

        # A late AdvancedSubscriber finds this token and asks this key for what it has missed, as it does with
        # an AdvancedPublisher of Zenoh. The answer counts against the limits of queries; one from the cache
        # of an AdvancedPublisher would not.
        history = f"{parameters}/@adv/pub/{session.info.zid()}/uhlc/_"

        def on_history(query: zenoh.Query) -> None:
            newest = self._parameters.get(source)
            answers = {} if newest is None else {parameters: Answer(newest.xml, XML, _facts(newest))}
            self.answers.reply(source, query, answers)

        return _Declared(
            queryable,
            publisher,
            session.declare_queryable(history, in_zenoh_thread(on_history)),
            session.liveliness().declare_token(history),
        )

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
        with self._lock:
            self._parameters[source] = parameters
        sent = self._publish_again(source)
        if sent is None:
            return None
        arrived = self._loop.create_future()

        def arrive() -> None:
            if not arrived.done():
                arrived.set_result(None)

        asyncio.wrap_future(sent, loop=self._loop).add_done_callback(
            lambda _: self._loop.call_later(_OVERTAKING_S, arrive)
        )
        return arrived

    def _publish_soon(self, source: str) -> None:
        """Publish the parameters again for a new subscriber."""
        if source not in self._due:
            self._due.add(source)
            self._publish_due(source)

    def _publish_due(self, source: str) -> None:
        """Publish the parameters again, unless that has just been done: a peer can appear again and again."""
        wait_s = self._published_s.get(source, -math.inf) + _AGAIN_S - time.monotonic()
        if wait_s > 0:
            self._loop.call_later(wait_s, self._publish_due, source)
            return
        self._published_s[source] = time.monotonic()
        self._due.discard(source)
        self._publish_again(source)

    def _publish_again(self, source: str) -> Future[None] | None:
        """Publish the newest parameters; while earlier ones wait to be sent, these replace them."""
        with self._lock:
            if self._is_closed or source not in self._declared or source not in self._parameters:
                return None
            sent = self._unsent.get(source)
            if sent is None or sent.done():  # no thread could be started
                sent = self._sender.submit(functools.partial(self._put_parameters, source))
                self._unsent[source] = sent
            return sent

    def _put_parameters(self, source: str) -> None:
        """Publish the newest parameters, in the sending thread."""
        with self._lock:
            del self._unsent[source]
            declared, parameters = self._declared.get(source), self._parameters.get(source)
        if declared is not None and parameters is not None:
            attachment = json_bytes(_facts(parameters))
            self._put(source, declared.publisher.put, parameters.xml, attachment=attachment)

    def announce_file(self, source: str, description: Mapping[str, Any]) -> None:
        """Announce a C3D file on the key that returns it."""
        if self._session is not None:
            key = zenoh_key(self._prefix, source, "c3d")
            put = functools.partial(
                self._put,
                *(source, self._session.put, key, json_bytes(description)),
                encoding=JSON,
                congestion_control=_RELIABLE,
                priority=_LOW_PRIORITY,
            )
            if not self._sender.offer(put) and not self._is_closed:
                text = "the announcement of a C3D file is dropped, because earlier ones wait to be sent"
                self.losses[source].lost("put failed", text, frames=0)

    def _put(self, source: str, put: Callable[..., None], *arguments: Any, **options: Any) -> None:
        """Publish, in the sending thread."""
        try:
            put(*arguments, **options)
        except zenoh.ZError as error:
            if not self._is_closed:
                text = f"Zenoh did not take parameters or an announcement: {zenoh_reason(error)}"
                self.losses[source].lost("put failed", text, frames=0)

    async def close(self) -> None:
        """Drop the pending queries. Their peers see at once that no reply follows."""
        self._is_closed = True
        await self.answers.close()


def _facts(parameters: ServerParameters) -> dict[str, Any]:
    """Return what is attached to published parameters."""
    return {
        "session": parameters.session,
        "parameters_version": parameters.version,
        "frame": parameters.frame.facts,
    }
