"""The Zenoh session of an output, which opens in a thread, and what the outputs declare on sessions.

``zenoh.open`` blocks; docs/design.md has the measurements.
"""

import json
import logging
import threading
import time
from collections.abc import Callable
from typing import Any, Final, NamedTuple, TypeVar

import zenoh

from gateway.errors import OutputError, raise_unless_defect
from gateway.outputs.contract import OutputHealth
from gateway.outputs.zenoh.config import prepare_threads, zenoh_reason
from gateway.runtime.failures import DefectLog, FailureLog, defect_text
from gateway.runtime.workers import thread_starts

_RETRY_S: Final = 1.0
_JOIN_S: Final = 0.5
_CLOSE_S: Final = 0.5
"""How long to wait for the opening thread and for the session to close.

A peer that does not read delays closing by 10 s; a thread then continues without the gateway.
"""

_MAX_CLOSING: Final = 4
"""How many sessions may be closing when another one is opened.

After hundreds of routers had connected and vanished, closing took 100 s. Until then, a session holds 15 MiB.
"""

_END_OF_TIME_S: Final = 2**32
"""Zenoh's time stamps end here, on 2106-02-07: a put at a later time panics."""

_WRONG_CLOCK: Final = (
    "the clock of this computer is beyond 2106-02-07, which Zenoh cannot express: set the clock"
)

_closers: Final[set[threading.Thread]] = set()  # of all outputs

_HEALTHY: Final = OutputHealth(True)

logger = logging.getLogger(__name__)


class SessionTexts(NamedTuple):
    """What users read about the session of an output."""

    output: str
    """The name of the output."""
    not_open: str
    cannot_open: str
    """Followed by Zenoh's reason and the remedy."""
    remedy: str
    no_router: str
    """The session is a client, and its router is gone."""
    opened: str
    """What succeeded."""


class SessionHolder:
    """The session of an output. Zenoh itself reconnects it once it is open.

    ``declare`` declares everything on the new session, in the thread that opens it and with ``lock`` held. If
    it raises, the session is closed, and the next one gets everything. ``on_link`` is called in any thread
    when ``is_cut_off`` may have changed, and before that ``on_link_lost`` when a connection has ended.
    """

    def __init__(
        self,
        texts: SessionTexts,
        config: zenoh.Config,
        declare: Callable[[zenoh.Session], None],
        on_link: Callable[[], None] = lambda: None,
        on_link_lost: Callable[[], None] = lambda: None,
    ) -> None:
        self.session: zenoh.Session | None = None
        """The open session, with everything declared on it; None before that, and after ``close``."""
        self.is_cut_off = True
        """Whether nothing can be sent; read for every message."""
        self.lock = threading.Lock()
        """Protects ``session`` and what the owner declares on it."""
        self._texts = texts
        self.is_client: Final = json.loads(config.get_json("mode") or "null") == "client"
        """Whether the session sends everything to one router."""
        self._declare = declare
        self._on_link = on_link
        self._on_link_lost = on_link_lost
        self.is_clock_wrong = False
        """Whether each put would panic, because Zenoh cannot express the time."""
        self._num_transports = 0
        self._counting = threading.Lock()  # of _num_transports, which several threads of Zenoh change
        self._router_failures = FailureLog(logger, texts.output)
        self._opener = SessionOpener(texts, config, self._use, self._update)

    def start(self) -> None:
        """Open the session, in a thread."""
        self._opener.start()

    def _use(self, session: zenoh.Session) -> bool:
        """Declare everything on a session that has just been opened; return False if it comes too late."""
        self._num_transports = 0
        session.info.declare_transport_events_listener(in_zenoh_thread(self._on_transport), history=True)
        with self.lock:
            if self._opener.is_stopped:  # close() closes only a session that is in use
                session.close()
                return False
            self._declare(session)
            self.session = session
        return True

    def _on_transport(self, event: zenoh.TransportEvent) -> None:
        with self._counting:
            self._num_transports += 1 if event.kind == zenoh.SampleKind.PUT else -1
        if event.kind == zenoh.SampleKind.DELETE:
            self._on_link_lost()
        self._update()

    def _update(self) -> None:
        self.is_clock_wrong = time.time() >= _END_OF_TIME_S
        self.is_cut_off = self.session is None or self.lacks_router or self.is_clock_wrong
        self._on_link()

    @property
    def lacks_router(self) -> bool:
        """Whether the session is that of a client, which needs a router, and none is connected."""
        return self.is_client and not self._num_transports

    @property
    def health(self) -> OutputHealth:
        """Whether messages can be sent, and if not, what to do."""
        if self.session is None:
            return OutputHealth(False, self._opener.problem)
        if self.is_clock_wrong:
            return OutputHealth(False, _WRONG_CLOCK)
        return OutputHealth(False, self._texts.no_router) if self.lacks_router else _HEALTHY

    @property
    def refusal(self) -> OutputError:
        """The error for a message that cannot be sent."""
        if self.session is not None and self.is_clock_wrong:
            return OutputError(_WRONG_CLOCK, cause="put failed")
        if self.session is not None and self.lacks_router:
            return OutputError(self._texts.no_router, cause="no router")
        # The session may be there already, and what is declared on it not yet.
        return OutputError(self._opener.problem, cause="not open")

    def maintain(self) -> None:
        """Log when the router goes and comes back. Called once a second."""
        self._update()  # in case two threads did it at once
        if self.session is None:
            return
        if self.lacks_router:
            self._router_failures.failed(self._texts.no_router)
        else:
            self._router_failures.recovered("connected to the router")

    def close(self) -> None:
        """Close the session, so that all that it has declared disappears."""
        self._opener.stop()
        with self.lock:
            session, self.session = self.session, None
            self._opener.problem = "the Zenoh session is closed; start the gateway again"
            self._update()
        if session is not None:
            close_session(session, self._texts.output)


class SessionOpener:
    """Opens a session in a thread of its own, and tries again until it succeeds.

    ``use`` prepares a session, and returns False if it is not wanted any more. If ``use`` raises, the session
    is closed, and another one is opened. ``on_open`` is called when the session is ready.
    """

    def __init__(
        self,
        texts: SessionTexts,
        config: zenoh.Config,
        use: Callable[[zenoh.Session], bool],
        on_open: Callable[[], None],
    ) -> None:
        self.problem = texts.not_open
        """Why there is no session."""
        self._texts = texts
        self._config = config
        self._use = use
        self._on_open = on_open
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{texts.output}-open", daemon=True)
        self._failures = FailureLog(logger, texts.output)
        self._defects = DefectLog(logger, texts.output)

    @property
    def is_stopped(self) -> bool:
        """Whether nobody wants a session any more."""
        return self._stopped.is_set()

    def start(self) -> None:
        """Start the thread."""
        thread_starts.start(self._thread)

    def stop(self) -> None:
        """Open no further session."""
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join(_JOIN_S)  # If zenoh.open blocks longer, the thread closes what it opens.

    def _run(self) -> None:
        prepare_threads()
        while not self.is_stopped:
            try:
                self._open()
            except OutputError as error:
                self.problem = str(error)
                self._failures.failed(self.problem)
            except zenoh.ZError as error:
                texts = self._texts
                self.problem = f"{texts.cannot_open}: {zenoh_reason(error)}; {texts.remedy}"
                self._failures.failed(self.problem)
            except BaseException as defect:  # noqa: BLE001 - the next try may succeed
                raise_unless_defect(defect)
                self.problem = defect_text(defect)
                self._defects.log(defect)
            else:
                return
            self._stopped.wait(_RETRY_S)

    def _open(self) -> None:
        num_closing = sum(closer.is_alive() for closer in tuple(_closers))
        if num_closing >= _MAX_CLOSING:
            raise OutputError(
                f"{num_closing} former Zenoh sessions are still closing, because programs connected to them "
                "do not read; the next one opens after them",
                cause="not open",
            )
        session = zenoh.open(self._config)
        try:
            is_used = self._use(session)
        except Exception:
            close_session(session, self._texts.output)
            raise
        if is_used:
            self.problem = ""
            self._on_open()
            self._failures.succeeded(self._texts.opened)


def close_session(session: zenoh.Session, output: str) -> None:
    """Close the session of an output; return when it is closed, or after _CLOSE_S."""

    def close() -> None:
        try:
            session.close()
        except zenoh.ZError as error:
            logger.debug("%s: closing the session: %s", output, zenoh_reason(error))
        finally:
            _closers.discard(threading.current_thread())

    closer = threading.Thread(target=close, name=f"{output}-close", daemon=True)
    _closers.add(closer)
    thread_starts.start(closer)
    closer.join(_CLOSE_S)


_Event = TypeVar("_Event")


def in_zenoh_thread(callback: Callable[[_Event], object]) -> "zenoh.handlers.Callback[_Event]":
    """Return a handler that calls ``callback`` in one of Zenoh's own threads, so it must not block.

    A plain function gets one more thread for each declaration: 256 tools had 572 threads, and 50 sources 50
    more than one.
    """
    return zenoh.handlers.Callback(callback, indirect=False)


def declare_publisher(
    session: zenoh.Session, key: str, on_matching: Callable[[bool], None], **options: Any
) -> zenoh.Publisher:
    """Declare a publisher with Zenoh's ``options``.

    ``on_matching`` is called in one of Zenoh's threads with True when a subscriber matches the key, which may
    be at once, and with False when none does any more.
    """
    publisher = session.declare_publisher(key, **options)

    def on_status(status: zenoh.MatchingStatus) -> None:
        on_matching(status.matching)

    publisher.declare_matching_listener(in_zenoh_thread(on_status))
    return publisher


def has_subscribers(publisher: zenoh.Publisher) -> bool:
    """Return whether a subscriber matches the key now: a notification may have been missed."""
    status: Any = publisher.matching_status  # a MatchingStatus, although Zenoh's type stub says bool
    return bool(status.matching)


def undeclare(declared: zenoh.Publisher | None, key: str) -> None:
    """Undeclare a publisher, if there is one; its session may be closed already."""
    if declared is not None:
        try:
            declared.undeclare()
        except zenoh.ZError as error:
            logger.debug("undeclaring %s: %s", key, zenoh_reason(error))
