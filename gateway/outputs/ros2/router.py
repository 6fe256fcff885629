"""The Zenoh session of the output: a client of the router that the ROS nodes use."""

import logging
import threading
from collections.abc import Callable
from typing import Final

import zenoh

from gateway.errors import OutputError
from gateway.log import FailureLog
from gateway.outputs.status import OutputHealth
from gateway.outputs.zenoh.closing import close_session
from gateway.outputs.zenoh.config import prepare_threads, zenoh_config, zenoh_reason

REMEDY: Final = "start it with `ros2 run rmw_zenoh_cpp rmw_zenohd`, or correct ros2.connect"

_RETRY_S: Final = 1.0
_JOIN_S: Final = 0.5
"""How long to wait for the session to close. The thread then continues without the gateway."""

_WAIT_BEFORE_DROP_US: Final = 11_000_000
"""How long Zenoh waits for a router that does not read, before it drops messages, which it does not count.

Until then, only the sending thread waits, and what finds no place in its queue is counted. This is longer
than the 10 s without a sign of life after which Zenoh gives a connection up.
"""

logger = logging.getLogger(__name__)


def client_config(endpoint: str) -> zenoh.Config:
    """Return the configuration of a client of one router, which it does not search by multicast."""
    return zenoh_config(
        {
            "mode": "client",
            "connect": {"endpoints": [endpoint]},
            "scouting": {"multicast": {"enabled": False}},
            "transport": {
                "link": {
                    "tx": {
                        "queue": {"congestion_control": {"drop": {"wait_before_drop": _WAIT_BEFORE_DROP_US}}}
                    }
                }
            },
        }
    )


class RouterSession:
    """Opens the session, and tries again until it succeeds. Zenoh itself reconnects afterwards.

    ``on_open`` gets the session, in the thread that opens it.
    """

    def __init__(self, endpoint: str, on_open: Callable[[zenoh.Session], None]) -> None:
        self.is_cut_off = True
        """Whether nothing can be sent; read for every frame."""
        self._endpoint = endpoint
        self._on_open = on_open
        self._lock = threading.Lock()  # of the session and of closing
        self._session: zenoh.Session | None = None
        self._num_transports = 0
        self._closing = threading.Event()
        self._opener = threading.Thread(target=self._open, name="ros2-open", daemon=True)
        self._problem = f"the Zenoh session to {endpoint} is not open yet; if there is no router, {REMEDY}"
        self._failures = FailureLog(logger, "ros2")

    def start(self) -> None:
        """Start the thread that opens the session."""
        self._opener.start()

    def _open(self) -> None:
        prepare_threads()
        while not self._closing.is_set():
            try:
                session = zenoh.open(client_config(self._endpoint))
            except zenoh.ZError as error:
                self._problem = f"no Zenoh router at {self._endpoint}: {zenoh_reason(error)}; {REMEDY}"
                self._failures.failed(self._problem)
                self._closing.wait(_RETRY_S)
                continue
            # In Zenoh's thread, so that nothing waits for a thread of Python at the end.
            events = zenoh.handlers.Callback(self._on_transport, indirect=False)
            session.info.declare_transport_events_listener(events, history=True)
            with self._lock:
                if self._closing.is_set():
                    session.close()
                    return
                self._session = session
            self._failures.succeeded(f"connected to the router at {self._endpoint}")
            self._on_open(session)
            self._update()
            return

    def _on_transport(self, event: zenoh.TransportEvent) -> None:
        self._num_transports += 1 if event.kind == zenoh.SampleKind.PUT else -1
        self._update()

    def _update(self) -> None:
        self.is_cut_off = self._session is None or self._num_transports == 0

    @property
    def health(self) -> OutputHealth:
        """Whether the router is connected, and if not, what to do."""
        if not self.is_cut_off:
            return OutputHealth(True)
        return OutputHealth(False, self.refusal.args[0])

    @property
    def refusal(self) -> OutputError:
        """The error for a message that cannot be sent."""
        if self._session is None:
            return OutputError(self._problem, cause="not open")
        return OutputError(
            f"the Zenoh router at {self._endpoint} is not connected any more; {REMEDY}", cause="no router"
        )

    def maintain(self) -> None:
        """Log when the router goes and comes back."""
        self._update()
        if self._session is None:
            return
        if self.is_cut_off:
            self._failures.failed(self.health.problem)
        else:
            self._failures.recovered(f"connected to the router at {self._endpoint}")

    def close(self) -> None:
        """Close the session, so that all that it has declared disappears."""
        self._closing.set()
        if self._opener.is_alive():
            self._opener.join(_JOIN_S)  # If zenoh.open blocks longer, the thread closes what it opens.
        with self._lock:
            session, self._session = self._session, None
            self._problem = "the Zenoh session is closed; start the gateway again"
            self._update()
        if session is not None:
            close_session(session, "ros2")
