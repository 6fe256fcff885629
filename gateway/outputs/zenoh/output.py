"""The Zenoh output: one session, its publishers, liveliness tokens and queryables."""

import asyncio
import logging
from collections.abc import Mapping
from functools import partial
from typing import Final

import zenoh

from gateway.logs.failures import DefectLog
from gateway.logs.losses import Losses
from gateway.messages.topics import Topic, zenoh_key
from gateway.outputs.contract import Output, OutputHealth, QueryService, ServerFile, ServerParameters
from gateway.outputs.zenoh.config import zenoh_config
from gateway.outputs.zenoh.declarations import SourceDeclarations
from gateway.outputs.zenoh.json_publishing import JsonConverter
from gateway.outputs.zenoh.publisher import ZenohLink, ZenohPublisher
from gateway.outputs.zenoh.session import SessionHolder, SessionTexts
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.workers import WorkerThread

_REMEDY: Final = "is the router running, are zenoh.config's endpoints right and free?"
_TEXTS: Final = SessionTexts(
    "zenoh",
    not_open=f"the Zenoh session is not open yet; {_REMEDY}",
    cannot_open="the Zenoh session does not open",
    remedy=_REMEDY,
    no_router="no Zenoh router is connected: start zenohd, or correct zenoh.config's connect/endpoints",
    opened="the session is open",
)

logger = logging.getLogger(__name__)


class ZenohOutput(Output):
    """One Zenoh session and everything declared on it.

    ``config`` is Zenoh's own configuration, if it is not that of ``settings``. Creating it raises
    ConfigError if Zenoh does not accept the configuration.
    """

    name = "zenoh"
    drop_causes = ("not open", "no router", "put failed")

    def __init__(self, settings: ZenohSettings, config: zenoh.Config | None = None) -> None:
        self.settings = settings
        self.max_rate_hz = settings.max_rate_hz
        self.has_tool_poses = settings.tool_poses
        self.config = zenoh_config(settings.config) if config is None else config
        self._holder = SessionHolder(_TEXTS, self.config, self._declare_all, self._update_link)
        self._link = ZenohLink(lambda: self._holder.refusal)
        self._json = JsonConverter(settings.json_max_rate_hz)
        # The lock of the session protects what the opening thread shares: publishers, tokens and queries.
        self._lock = self._holder.lock
        self._publishers: list[ZenohPublisher] = []
        # By the source's name and the token's; None while the session is not open.
        self._tokens: dict[tuple[str, str], zenoh.LivelinessToken | None] = {}
        self._declarations: SourceDeclarations | None = None
        self._declarer = WorkerThread("zenoh-declare")
        self._defects = DefectLog(logger, self.name)

    @property
    def session(self) -> zenoh.Session | None:
        """The open session; None before it opens and after ``close``."""
        return self._holder.session

    def start(self) -> None:
        """Start the thread that opens the session and retries until it succeeds or ``close`` is called."""
        self._holder.start()

    def wait_until_open(self, timeout_s: float) -> None:
        """Wait until the session is open, with everything declared on it."""
        self._holder.wait(timeout_s)

    def _declare_all(self, session: zenoh.Session) -> None:
        """Declare on a new session everything that was requested before it opened."""
        for publisher in self._publishers:
            publisher.declare(session)
        for token in self._tokens:
            self._tokens[token] = self._token(session, *token)
        if self._declarations is not None:
            sources = [source for source, name in self._tokens if name == "alive"]
            self._declarations.open(session, sources)  # the parameters, before the first frame

    def _update_link(self) -> None:
        self._link.is_cut_off = self._holder.is_cut_off

    def _token(self, session: zenoh.Session, source: str, name: str) -> zenoh.LivelinessToken:
        return session.liveliness().declare_token(zenoh_key(self.settings.prefix, source, name))

    def publisher(self, topic: Topic) -> ZenohPublisher:
        """Return a new publisher of ``topic``. It can send when the session is open.

        A server may have hundreds of tools. Their keys are declared in a thread, because each takes 1 ms;
        until then, they have no subscribers.
        """
        is_of_item = len(topic.path) > 1
        key = zenoh_key(self.settings.prefix, topic.source, *topic.path)
        publisher = ZenohPublisher(self._link, key, topic.type_name, self.settings.express, self._forget)
        publisher.json = self._json.publisher(topic, key, publisher.update_wanted)
        with self._lock:
            self._publishers.append(publisher)
            session = self.session
            if session is not None and not is_of_item:
                publisher.declare(session)
        if session is not None and is_of_item:
            declare = partial(self._declare_late, publisher, session)
            self._declarer.submit(partial(self._defects.attempt, declare, None))
        return publisher

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

    def health(self) -> OutputHealth:
        """Return whether messages can be sent."""
        return self._holder.health

    def maintain(self) -> None:
        """Log whether a client has its router, and check for subscribers. Zenoh itself reconnects."""
        self._holder.maintain()
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

    # Sources: liveliness, queries, parameters.

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` refused queries about ``source``, and what else is not published of it."""
        self._json.losses[source] = losses
        if self._declarations is not None:
            self._declarations.losses[source] = losses

    def announce(self, source: str) -> None:
        """Declare the liveliness token PREFIX/SOURCE/alive, and answer queries about ``source``."""
        self._show(source, "alive", True)
        with self._lock:
            if self._declarations is not None and self.session is not None:
                self._declarations.add(source)

    def withdraw(self, source: str) -> None:
        """Undeclare the liveliness token PREFIX/SOURCE/alive, and stop answering queries about ``source``."""
        self._show(source, "alive", False)
        with self._lock:
            if self._declarations is not None:
                self._declarations.remove(source)

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

    def publish_parameters(self, source: str, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """Publish the XML on PREFIX/SOURCE/parameters, now and for each later subscriber."""
        self._json.set_parameters(source, parameters)
        return (
            None if self._declarations is None else self._declarations.publish_parameters(source, parameters)
        )

    def announce_file(self, source: str, file: ServerFile) -> None:
        """Publish the description of a C3D file on PREFIX/SOURCE/c3d, the key that returns it."""
        if self._declarations is not None:
            self._declarations.announce_file(source, file.description)

    def serve_queries(self, service: QueryService) -> None:
        """Answer queries below PREFIX/SOURCE/ for every announced source."""
        self._declarations = SourceDeclarations(self.settings, service, asyncio.get_running_loop())

    async def stop_queries(self) -> None:
        """Drop the pending queries. Their peers see at once that no reply follows."""
        if self._declarations is not None:
            await self._declarations.close()

    @property
    def query_results(self) -> Mapping[str, Mapping[str, int]] | None:
        """By source, the number of queries by result; None before ``serve_queries``."""
        return None if self._declarations is None else self._declarations.answers.admission.results

    def close(self) -> None:
        """Close the session. Otherwise a process with Zenoh callbacks never ends."""
        self._json.close()
        self._holder.close()
        with self._lock:
            self._tokens.clear()
