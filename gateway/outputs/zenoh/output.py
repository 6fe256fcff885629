"""Messages out on Zenoh: one publisher per key, a liveliness token per source.

Opened in a thread of its own, because ``zenoh.open`` blocks; see docs/design.md for what was measured.
"""

import json
import logging
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import zenoh

from gateway.config.settings import ZenohSettings
from gateway.config.values import zenoh_reason
from gateway.errors import ConfigError, OutputError
from gateway.log import FailureLog
from gateway.messages.topics import Topic, zenoh_key
from gateway.outputs.status import OutputHealth

LCM_ENCODING: Final = "application/x-lcm"
"""The Zenoh encoding of every message; its schema is the LCM type: ``application/x-lcm;rtc3d.markers_t``."""

_DEFAULTS: Final = {
    # 16 MB of /dev/shm, and files left behind after a kill, for messages of a few kB.
    "transport": {"shared_memory": {"enabled": False}},
    # Caches for late subscribers need samples with time stamps.
    "timestamping": {"enabled": True},
    # A lost router is found again within half a second instead of up to 4 s.
    "connect": {"retry": {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 1.5}},
}
"""What the gateway wants other than Zenoh's own defaults, where an inline configuration is silent."""

_REMEDY: Final = "is the router running, are zenoh.config's endpoints right and free?"
_NO_ROUTER: Final = OutputHealth(
    False, "no Zenoh router is connected: start zenohd, or correct zenoh.config's connect/endpoints"
)
_HEALTHY: Final = OutputHealth(True)
_RETRY_S: Final = 1.0
_JOIN_S: Final = 0.5
_CLOSE_S: Final = 0.5
"""How long closing may take. A peer that does not read holds it up for 10 s: that is left behind."""

logger = logging.getLogger(__name__)


def zenoh_config(config: Path | Mapping[str, Any]) -> zenoh.Config:
    """Return Zenoh's configuration from a JSON5 file, as it stands, or from keys given inline.

    Raises ConfigError with Zenoh's own reason.
    """
    try:
        if isinstance(config, Path):
            return zenoh.Config.from_file(str(config))
        return zenoh.Config.from_json5(json.dumps(_merged(_DEFAULTS, config)))
    except (zenoh.ZError, TypeError, ValueError) as error:
        where = f"file {config}" if isinstance(config, Path) else "inline zenoh.config"
        raise ConfigError(f"Zenoh does not accept the {where}: {zenoh_reason(error)}") from error


def _merged(defaults: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(defaults)
    for key, value in given.items():
        default = merged.get(key)
        if isinstance(default, Mapping) and isinstance(value, Mapping):
            merged[key] = _merged(default, value)
        else:
            merged[key] = value
    return merged


class ZenohPublisher:
    """Sends the messages of one topic, DROP on congestion: a stalled subscriber delays nobody."""

    def __init__(self, output: "ZenohOutput", topic: Topic) -> None:
        self._output = output
        self._key = zenoh_key(output.settings.prefix, topic.source, *topic.path)
        self._type_name = topic.type_name
        self._publisher: zenoh.Publisher | None = None
        self._closed = False
        self.wanted = False
        """Whether a subscriber matches the key now."""

    def bind(self, session: zenoh.Session) -> None:
        """Declare the publisher on an open session."""
        publisher = session.declare_publisher(
            self._key,
            encoding=zenoh.Encoding(LCM_ENCODING).with_schema(self._type_name),
            congestion_control=zenoh.CongestionControl.DROP,
            express=self._output.settings.express,
        )
        publisher.declare_matching_listener(self._on_matching)  # tells of subscribers there already, too
        self._publisher = publisher

    def look(self) -> None:
        """See again whether anybody listens: a notification may have been missed."""
        # Zenoh's type stub says that matching_status is a bool; it is the MatchingStatus that listeners get.
        publisher: Any = self._publisher
        if publisher is not None:
            self.wanted = publisher.matching_status.matching

    def _on_matching(self, status: zenoh.MatchingStatus) -> None:
        # From Zenoh's thread; setting a flag is all it does.
        self.wanted = status.matching and not self._closed

    def publish(self, message: bytes) -> None:
        """Hand ``message`` to Zenoh; raises OutputError while not open, or a client without a router."""
        if self._publisher is None or self._output.is_cut_off:
            raise self._refusal()
        try:
            self._publisher.put(message)
        except zenoh.ZError as error:
            text = f"Zenoh did not take a message for {self._key}: {zenoh_reason(error)}"
            raise OutputError(text, cause="put failed") from error

    def _refusal(self) -> OutputError:
        if self._closed:
            return OutputError(f"Zenoh key {self._key} is closed; ask for a new publisher", cause="closed")
        cause = "not open" if self._output.session is None else "no router"
        return OutputError(self._output.health().problem, cause=cause)

    def close(self) -> None:
        """Undeclare the publisher."""
        self._closed = True
        self.wanted = False
        self._output.forget(self)
        publisher, self._publisher = self._publisher, None
        if publisher is not None:
            try:
                publisher.undeclare()
            except zenoh.ZError as error:
                logger.debug("undeclaring %s: %s", self._key, error)


def _close(session: zenoh.Session) -> None:
    try:
        session.close()
    except zenoh.ZError as error:
        logger.debug("zenoh: closing the session: %s", zenoh_reason(error))


class ZenohOutput:
    """One Zenoh session and its publishers. Raises ConfigError if Zenoh refuses the configuration."""

    name = "zenoh"

    def __init__(self, settings: ZenohSettings) -> None:
        self.settings = settings
        self.max_rate_hz = settings.max_rate_hz
        self.config = zenoh_config(settings.config)
        self._is_client = json.loads(self.config.get_json("mode") or "null") == "client"
        self._lock = threading.Lock()  # of _session, _publishers and the tokens, shared with _opener
        self._session: zenoh.Session | None = None
        self._publishers: list[ZenohPublisher] = []
        self._declarations: list[Callable[[zenoh.Session], None]] = []
        # By the source's name; None while the session is not open.
        self._alive: dict[str, zenoh.LivelinessToken | None] = {}
        self._flowing: dict[str, zenoh.LivelinessToken | None] = {}
        self._transports = 0
        self.is_cut_off = True
        """Whether nothing can leave: not open, or without its router. Kept, because every message asks."""
        self._problem = f"the Zenoh session is not open yet; {_REMEDY}"
        self._closing = threading.Event()
        self._opener = threading.Thread(target=self._open, name="zenoh-open", daemon=True)
        self._failures = FailureLog(logger, self.name)
        self._links = FailureLog(logger, self.name)

    @property
    def session(self) -> zenoh.Session | None:
        """The open session; None before it opens and after ``close``."""
        return self._session

    @property
    def lacks_router(self) -> bool:
        """Whether this is a client (it reaches others through a router only) without its router."""
        return self._is_client and self._transports == 0

    def start(self) -> None:
        """Begin to open the session, again and again until it opens or ``close`` is called."""
        self._opener.start()

    def _open(self) -> None:
        while not self._closing.is_set():
            try:
                session = zenoh.open(self.config)
            except zenoh.ZError as error:
                self._problem = f"the Zenoh session does not open: {zenoh_reason(error)}; {_REMEDY}"
                self._failures.failed(self._problem)
                self._closing.wait(_RETRY_S)
                continue
            session.info.declare_transport_events_listener(self._on_transport, history=True)
            with self._lock:
                if self._closing.is_set():
                    session.close()
                    return
                for publisher in self._publishers:
                    publisher.bind(session)
                for source in self._alive:
                    self._alive[source] = self._token(session, source, "alive")
                for source in self._flowing:
                    self._flowing[source] = self._token(session, source, "server")
                self._session = session
                self._look()
                for declare in self._declarations:
                    declare(session)
            self._problem = ""
            self._failures.succeeded("the session is open")
            return

    def _on_transport(self, event: zenoh.TransportEvent) -> None:
        self._transports += 1 if event.kind == zenoh.SampleKind.PUT else -1
        self._look()

    def _look(self) -> None:
        """See whether anything can leave; ``maintain`` does so again, should two threads have crossed."""
        self.is_cut_off = self._session is None or self.lacks_router

    def _token(self, session: zenoh.Session, source: str, name: str) -> zenoh.LivelinessToken:
        return session.liveliness().declare_token(zenoh_key(self.settings.prefix, source, name))

    def publisher(self, topic: Topic) -> ZenohPublisher:
        """Return a new publisher of ``topic``; it sends as soon as the session is open."""
        publisher = ZenohPublisher(self, topic)
        with self._lock:
            self._publishers.append(publisher)
            if self._session is not None:
                publisher.bind(self._session)
        return publisher

    def forget(self, publisher: ZenohPublisher) -> None:
        """Drop a closed publisher."""
        with self._lock:
            if publisher in self._publishers:
                self._publishers.remove(publisher)

    def announce(self, source: str) -> None:
        """Hold the liveliness token PREFIX/SOURCE/alive."""
        self._show(self._alive, source, "alive", True)

    def withdraw(self, source: str) -> None:
        """Let the liveliness token PREFIX/SOURCE/alive go."""
        self._show(self._alive, source, "alive", False)

    def show_flowing(self, source: str, flowing: bool) -> None:
        """Hold the liveliness token PREFIX/SOURCE/server while frames flow, and only then."""
        self._show(self._flowing, source, "server", flowing)

    def _show(
        self, tokens: dict[str, zenoh.LivelinessToken | None], source: str, name: str, shown: bool
    ) -> None:
        with self._lock:
            if not shown:
                token = tokens.pop(source, None)
                if token is not None:
                    token.undeclare()
            elif source not in tokens:
                tokens[source] = None if self._session is None else self._token(self._session, source, name)

    def when_open(self, declare: Callable[[zenoh.Session], None]) -> None:
        """Call ``declare`` with the session once it is open, in the thread that opens it."""
        with self._lock:
            self._declarations.append(declare)
            if self._session is not None:
                declare(self._session)

    def maintain(self) -> None:
        """Tell of a router lost or found; Zenoh itself reconnects."""
        self._look()
        if self._session is None:
            return
        with self._lock:
            for publisher in self._publishers:
                publisher.look()
        if self.lacks_router:
            self._links.failed(self.health().problem)
        elif self._links.failing:
            self._links.recovered("connected to the router")

    def health(self) -> OutputHealth:
        """Return whether messages can leave."""
        if self._session is None:
            return OutputHealth(False, self._problem)
        if self.lacks_router:
            return _NO_ROUTER
        return _HEALTHY

    def close(self) -> None:
        """Close the session: without it a process with callbacks never ends."""
        self._closing.set()
        if self._opener.is_alive():
            self._opener.join(_JOIN_S)  # an open() that blocks is left behind; it closes what it opens
        with self._lock:
            session, self._session = self._session, None
            self._look()
            self._alive.clear()
            self._flowing.clear()
            self._problem = "the Zenoh session is closed; start the gateway again"
        if session is not None:
            closer = threading.Thread(target=_close, args=(session,), name="zenoh-close", daemon=True)
            closer.start()
            closer.join(_CLOSE_S)
