"""The Zenoh output: one session, and what is declared on it for topics and for sources."""

import asyncio
import contextlib
import functools
import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any, Final, NamedTuple

import zenoh

from gateway.errors import raise_unless_defect
from gateway.messages.decode import JSON, XML, json_bytes
from gateway.messages.topics import Topic, zenoh_key
from gateway.outputs.contract import Answer, Output, OutputHealth, QueryService, ServerFile, ServerParameters
from gateway.outputs.other_gateways import OtherGateways
from gateway.outputs.zenoh.answers import ZenohAnswers
from gateway.outputs.zenoh.config import zenoh_config, zenoh_reason
from gateway.outputs.zenoh.confirmation import LINK_LOST, SILENT_S, RouterConfirmation
from gateway.outputs.zenoh.json_publishing import JsonConverter
from gateway.outputs.zenoh.open_ports import is_open_to_others
from gateway.outputs.zenoh.publisher import ZenohLink, ZenohPublisher
from gateway.outputs.zenoh.session import SessionHolder, SessionTexts, declare_publisher, in_zenoh_thread
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.runtime.failures import DefectLog, defect_text
from gateway.runtime.losses import Losses
from gateway.runtime.workers import WorkerThread

# Parameters must arrive, even if that takes longer, and messages of streams have priority.
_RELIABLE: Final = zenoh.CongestionControl.BLOCK
_LOW_PRIORITY: Final = zenoh.Priority.DATA_LOW

_OVERTAKING_S: Final = 0.05
"""For how long messages of streams could overtake parameters, because of their priority.

With 1000 messages per second on a busy computer, they did so for up to 7 ms after 2 of 80 publications.
"""

_AGAIN_S: Final = 0.5
"""How long to wait at least before the parameters are published for a new subscriber again."""

_REMEDY: Final = "is the router running, are zenoh.config's endpoints right and free?"
TEXTS: Final = SessionTexts(
    "zenoh",
    not_open=f"the Zenoh session is not open yet; {_REMEDY}",
    cannot_open="the Zenoh session does not open",
    remedy=_REMEDY,
    no_router="no Zenoh router is connected: start zenohd, or correct zenoh.config's connect/endpoints",
    opened="the session is open",
)
"""What the log and the status say about the session."""

logger = logging.getLogger(__name__)


class _Declared(NamedTuple):
    """What is declared on the session for one source besides its topics and liveliness tokens."""

    queryable: zenoh.Queryable[None]
    publisher: zenoh.Publisher
    history: zenoh.Queryable[None]
    history_token: zenoh.LivelinessToken
    others: zenoh.Subscriber[None]


class ZenohOutput(Output):
    """One Zenoh session and everything declared on it.

    For each source, these are publishers of its topics and of its parameters, liveliness tokens, and one
    queryable. ``config`` is Zenoh's own configuration, if it is not that of ``settings``. Creating it raises
    ConfigError if Zenoh does not accept the configuration.
    """

    name = "zenoh"
    drop_causes = ("not open", "no router", LINK_LOST, "put failed")

    def __init__(self, settings: ZenohSettings, config: zenoh.Config | None = None) -> None:
        self.settings = settings
        self.max_rate_hz = settings.max_rate_hz
        self.has_tool_poses = settings.tool_poses
        self.config = zenoh_config(settings.config) if config is None else config
        self._holder = SessionHolder(
            *(TEXTS, self.config, self._declare_all, self._update_link), on_link_lost=self._lose_link
        )
        self._confirmation = RouterConfirmation(self._holder)
        self._link = ZenohLink(lambda: self._holder.refusal)
        self._others = OtherGateways(self.name)
        self._json = JsonConverter(settings.json_max_rate_hz)
        self._losses = self._json.losses
        self._sender = WorkerThread("zenoh-send")
        self._declarer = WorkerThread("zenoh-declare")
        self._defects = DefectLog(logger, self.name)
        self._loop: asyncio.AbstractEventLoop  # from ``serve_queries`` on
        self._answers: ZenohAnswers | None = None
        self._has_stopped = False  # answering and publishing parameters
        self._due: set[str] = set()  # sources whose parameters will be published for a new subscriber
        self._published_s: dict[str, float] = {}  # when that was done last
        # The lock of the session protects what several threads share.
        self._lock = self._holder.lock
        self._publishers: list[ZenohPublisher] = []
        # By the source's name and the token's; None while the session is not open.
        self._tokens: dict[tuple[str, str], zenoh.LivelinessToken | None] = {}
        self._declared: dict[str, _Declared] = {}  # by the source's name, like the next two
        self._parameters: dict[str, ServerParameters] = {}
        self._unsent: dict[str, Future[None]] = {}  # publications of parameters that have not begun

    @property
    def session(self) -> zenoh.Session | None:
        """The open session; None before it opens and after ``close``."""
        return self._holder.session

    def start(self) -> None:
        """Start the thread that opens the session and retries until it succeeds or ``close`` is called."""
        if is_open_to_others(self.config):
            logger.info(
                "zenoh: programs on other computers can subscribe and publish, without a password; "
                "`rtc3d-gateway doctor --exposure` lists what is open"
            )
        self._holder.start()

    def _declare_all(self, session: zenoh.Session) -> None:
        """Declare on a new session everything that was requested before it opened."""
        for publisher in self._publishers:
            publisher.declare(session)
        for token in self._tokens:
            self._tokens[token] = self._token(session, *token)
        if self._answers is not None:
            sources = [source for source, name in self._tokens if name == "alive"]
            self._declared = {source: self._declare(session, source, self._answers) for source in sources}
            for source in sources:  # the parameters, before the first frame
                self._call_in_loop(self._publish_again, source)

    def _update_link(self) -> None:
        self._link.is_cut_off = self._holder.is_cut_off

    def _lose_link(self) -> None:
        if self._holder.is_client:
            self._confirmation.lose_link()

    def _token(self, session: zenoh.Session, source: str, name: str) -> zenoh.LivelinessToken:
        return session.liveliness().declare_token(zenoh_key(self.settings.prefix, source, name))

    def publisher(self, topic: Topic) -> ZenohPublisher:
        """Return a new publisher of ``topic``. It can send when the session is open.

        A server may have hundreds of tools. Their keys are declared in a thread, because each takes 1 ms;
        until then (``until_declared``), they have no subscribers.
        """
        is_of_item = len(topic.path) > 1
        key = zenoh_key(self.settings.prefix, topic.source, *topic.path)
        publisher = ZenohPublisher(
            *(self._link, key, topic.type_name, self.settings.express, self._forget),
            self._confirmation.of(topic.source),
        )
        publisher.json = self._json.publisher(topic, key, publisher.update_wanted)
        with self._lock:
            self._publishers.append(publisher)
            session = self.session
            if session is not None and not is_of_item:
                publisher.declare(session)
        if session is not None and is_of_item:
            declare = functools.partial(self._declare_late, publisher, session)
            self._declarer.submit(functools.partial(self._defects.attempt, declare, None))
        return publisher

    def until_declared(self) -> Future[None] | None:
        """Return what is done when the keys of tools are declared that were asked for so far."""
        return None if self.session is None else self._declarer.submit(lambda: None)

    def _declare_late(self, publisher: ZenohPublisher, session: zenoh.Session) -> None:
        try:
            publisher.declare(session)
        except zenoh.ZError:
            if self.session is session:  # it has not been closed meanwhile
                raise

    def _forget(self, publisher: ZenohPublisher) -> None:
        with self._lock:
            if publisher in self._publishers:
                self._publishers.remove(publisher)

    def warnings(self) -> Sequence[str]:
        """Return which sources other gateways publish, too. They have the same liveliness tokens."""
        return self._others.warnings

    def health(self) -> OutputHealth:
        """Return whether messages can be sent, and whether the router of a client reads them."""
        health, silent_s = self._holder.health, self._confirmation.silent_s
        if silent_s < SILENT_S or not health.connected:
            return health
        return OutputHealth(
            False, f"the Zenoh router has read nothing for {silent_s:.0f} s: check it and the network to it"
        )

    def maintain(self) -> None:
        """Log whether a client has its router, and check for subscribers. Zenoh itself reconnects."""
        self._holder.maintain()
        self._confirmation.check()
        self._others.check()
        self._confirmation.count_unconfirmed(self._losses, "the Zenoh router")
        if self.session is not None:
            with self._lock:
                for publisher in self._publishers:
                    publisher.check_subscribers()

    def is_configured_like(self, other: Output) -> bool:
        """Return whether the settings and the content of Zenoh's configuration file are the same."""
        return (
            isinstance(other, ZenohOutput)
            and self.settings == other.settings.model_copy(update={"tool_poses": self.settings.tool_poses})
            and str(self.config) == str(other.config)
        )

    def close(self) -> None:
        """Close the session. Otherwise a process with Zenoh callbacks never ends."""
        self._json.close()
        self._holder.close()
        with self._lock:
            self._tokens.clear()

    # Sources: liveliness and queries.

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` what is lost of ``source``: queries, parameters, announcements and JSON."""
        self._losses[source] = losses

    def announce(self, source: str) -> None:
        """Declare the liveliness token PREFIX/SOURCE/alive, and answer queries about ``source``."""
        self._show(source, "alive", True)
        with self._lock:
            session = self.session
            if self._answers is not None and session is not None and source not in self._declared:
                self._declared[source] = self._declare(session, source, self._answers)

    def withdraw(self, source: str) -> None:
        """Undeclare the liveliness token PREFIX/SOURCE/alive, and stop answering queries about ``source``."""
        self._show(source, "alive", False)
        with self._lock:
            self._parameters.pop(source, None)
            declared = self._declared.pop(source, None)
        if declared is not None:
            declared.others.undeclare()
            self._others.forget(source)
            declared.history_token.undeclare()
            declared.history.undeclare()
            declared.queryable.undeclare()
            # The thread may be sending on this one, and Zenoh refuses to undeclare it meanwhile.
            self._sender.submit(declared.publisher.undeclare)

    def show_streaming(self, source: str, is_streaming: bool) -> None:
        """Declare the liveliness token PREFIX/SOURCE/server while frames arrive, undeclare it otherwise."""
        self._show(source, "server", is_streaming)

    def _show(self, source: str, name: str, is_shown: bool) -> None:
        with self._lock:
            session = self.session
            if not is_shown:
                token = self._tokens.pop((source, name), None)
                if token is not None:
                    token.undeclare()
            elif (source, name) not in self._tokens:
                self._tokens[source, name] = session and self._token(session, source, name)

    def serve_queries(self, service: QueryService) -> None:
        """Answer queries below PREFIX/SOURCE/ for every announced source."""
        self._loop = asyncio.get_running_loop()
        self._answers = ZenohAnswers(self.settings, service, self._loop, self._sender, self._losses)

    async def stop_queries(self) -> None:
        """Drop the pending queries. Their peers see at once that no reply follows."""
        if self._answers is not None:
            self._has_stopped = True
            await self._answers.close()

    @property
    def query_results(self) -> Mapping[str, Mapping[str, int]] | None:
        """By source, the number of queries by result; None before ``serve_queries``."""
        return None if self._answers is None else self._answers.admission.results

    def _declare(self, session: zenoh.Session, source: str, answers: ZenohAnswers) -> _Declared:
        key = zenoh_key(self.settings.prefix, source)
        parameters = f"{key}/parameters"

        def on_matching(is_matched: bool) -> None:
            if is_matched:
                self._call_in_loop(self._publish_soon, source)

        # A late AdvancedSubscriber finds this token and asks this key for what it has missed, as it does with
        # an AdvancedPublisher of Zenoh. The answer counts against the limits of queries; one from the cache
        # of an AdvancedPublisher would not.
        history = f"{parameters}/@adv/pub/{session.info.zid()}/uhlc/_"

        def on_history(query: zenoh.Query) -> None:
            newest = self._parameters.get(source)
            found = {} if newest is None else {parameters: Answer(newest.xml, XML, _facts(newest))}
            answers.reply(source, query, found)

        own_id = str(session.info.zid())

        def on_gateway(sample: zenoh.Sample) -> None:
            gateway = str(sample.key_expr).split("/")[-3]
            if gateway != own_id:
                note = self._others.seen if sample.kind == zenoh.SampleKind.PUT else self._others.gone
                note(source, gateway)

        on_query = in_zenoh_thread(functools.partial(answers.receive, source))
        return _Declared(
            session.declare_queryable(f"{key}/**", on_query),
            declare_publisher(
                *(session, parameters, on_matching),
                encoding=XML,
                congestion_control=_RELIABLE,
                priority=_LOW_PRIORITY,
            ),
            session.declare_queryable(history, in_zenoh_thread(on_history)),
            session.liveliness().declare_token(history),
            session.liveliness().declare_subscriber(
                f"{parameters}/@adv/pub/*/uhlc/_", in_zenoh_thread(on_gateway), history=True
            ),
        )

    def _call_in_loop(self, call: Callable[..., object], *arguments: Any) -> None:
        """Call ``call`` in the event loop, from one of Zenoh's threads or the one that opens the session."""
        with contextlib.suppress(RuntimeError):  # the loop has just ended
            self._loop.call_soon_threadsafe(call, *arguments)

    # Sources: parameters and files.

    def publish_parameters(self, source: str, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """Publish the XML on PREFIX/SOURCE/parameters, now and for each later subscriber.

        Returns a future that is done when messages can no longer overtake it; None while the session is not
        open.
        """
        self._json.set_parameters(source, parameters)
        if self._answers is None:
            return None
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
            if self._has_stopped or source not in self._declared or source not in self._parameters:
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

    def announce_file(self, source: str, file: ServerFile) -> None:
        """Publish the description of a C3D file on PREFIX/SOURCE/c3d, the key that returns it."""
        session = self.session  # closing it in another thread makes it None
        if self._answers is not None and session is not None:
            key = zenoh_key(self.settings.prefix, source, "c3d")
            put = functools.partial(
                self._put,
                *(source, session.put, key, json_bytes(file.description)),
                encoding=JSON,
                congestion_control=_RELIABLE,
                priority=_LOW_PRIORITY,
            )
            if not self._sender.offer(put) and not self._has_stopped:
                text = "the announcement of a C3D file is dropped, because earlier ones wait to be sent"
                self._losses[source].lost("put failed", text, frames=0)

    def _put(self, source: str, put: Callable[..., None], *arguments: Any, **options: Any) -> None:
        """Publish, in the sending thread."""
        if self._holder.is_clock_wrong:
            self._losses[source].lost("put failed", str(self._holder.refusal), frames=0)
            return
        try:
            put(*arguments, **options)
        except zenoh.ZError as error:
            if not self._has_stopped:
                text = f"Zenoh did not take parameters or an announcement: {zenoh_reason(error)}"
                self._losses[source].lost("put failed", text, frames=0)
        except BaseException as defect:  # noqa: BLE001 - the thread continues
            raise_unless_defect(defect)
            self._defects.log(defect)
            text = f"Zenoh did not take parameters or an announcement: {defect_text(defect)}"
            self._losses[source].lost("put failed", text, frames=0)


def _facts(parameters: ServerParameters) -> dict[str, Any]:
    """Return what is attached to published parameters."""
    return {
        "session": parameters.session,
        "parameters_version": parameters.version,
        "frame": parameters.frame.facts,
    }
