"""The output for ROS 2: a node with publishers, on the Zenoh router that ROS uses.

All calls of Zenoh that can block are made in one thread, which also encodes the messages.
"""

import asyncio
import contextlib
import functools
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError
from typing import Final

import zenoh

from gateway.messages.ros2.encode import DIAGNOSTIC_ARRAY, TF_MESSAGE
from gateway.messages.ros2.names import MAX_PART_CHARS, TF, ros_name
from gateway.messages.topics import Topic, unique_name
from gateway.outputs.adapters.ros2.diagnostics import DiagnosticsPublisher
from gateway.outputs.adapters.ros2.latched import StaticTransforms
from gateway.outputs.adapters.ros2.settings import Ros2Settings
from gateway.outputs.adapters.ros2.source import RosSource
from gateway.outputs.adapters.ros2.topic import RosNode, RosTopic
from gateway.outputs.contract import FramePublisher, OutputHealth, Publisher, ServerParameters
from gateway.outputs.frame_output import FrameOutput, in_this_loop
from gateway.outputs.zenoh.config import zenoh_config
from gateway.outputs.zenoh.confirmation import LINK_LOST, SILENT_S, RouterConfirmation
from gateway.outputs.zenoh.session import SessionHolder, SessionTexts
from gateway.runtime.losses import Losses
from gateway.runtime.workers import WorkerThread

REMEDY: Final = "start it with `ros2 run rmw_zenoh_cpp rmw_zenohd`, or correct ros2.connect"

_WAIT_BEFORE_DROP_US: Final = 70_000_000
"""How long Zenoh waits for a router that does not read, before it drops messages, which it does not count.

Until then, only the sending thread waits, and what finds no place in its queue is counted. This is longer
than the 60 s without a sign of life after which Zenoh gives a connection to rmw_zenohd up.
"""

_LEASE_MS: Final = 60_000
_KEEP_ALIVES: Final = 2
"""As in rmw_zenoh's own configuration of sessions: after a pause, a router reads what waits for it.

The router gives a connection up on which it has read nothing for this long. With Zenoh's own 10 s, a router
that was paused for longer did so before it read the messages, and all of them were lost.
"""


def client_config(endpoint: str) -> zenoh.Config:
    """Return the configuration of a client of one router, which it does not search by multicast."""
    queue = {"congestion_control": {"drop": {"wait_before_drop": _WAIT_BEFORE_DROP_US}}}
    return zenoh_config(
        {
            "mode": "client",
            "connect": {"endpoints": [endpoint]},
            "scouting": {"multicast": {"enabled": False}},
            "transport": {"link": {"tx": {"lease": _LEASE_MS, "keep_alive": _KEEP_ALIVES, "queue": queue}}},
        }
    )


def router_session(
    endpoint: str, declare: Callable[[zenoh.Session], None], on_link_lost: Callable[[], None]
) -> SessionHolder:
    """Return the holder of a session with the router at ``endpoint``."""
    texts = SessionTexts(
        "ros2",
        not_open=f"the Zenoh session to {endpoint} is not open yet; if there is no router, {REMEDY}",
        cannot_open=f"no Zenoh router at {endpoint}",
        remedy=REMEDY,
        no_router=f"the Zenoh router at {endpoint} is not connected any more; {REMEDY}",
        opened=f"connected to the router at {endpoint}",
    )
    return SessionHolder(texts, client_config(endpoint), declare, on_link_lost=on_link_lost)


_STATUS: Final = ("status",)
_UNDECLARE_S: Final = 0.5
"""How long to wait for this before the session is closed: the router may have stopped reading."""

_HUNG_S: Final = 2.0
"""A router that takes no message for this long does not read. Its connection counts as up for up to 60 s."""


class Ros2Output(FrameOutput):
    """Publishes for ROS 2 in the wire format of rmw_zenoh."""

    name = "ros2"
    drop_causes = ("not open", "no router", LINK_LOST, "queue full", "put failed", "unknown unit")

    def __init__(self, settings: Ros2Settings) -> None:
        self.settings: Ros2Settings = settings
        self._router = router_session(settings.connect, self._declare_in_thread, self._lose_link)
        self._confirmation = RouterConfirmation(self._router)
        self._sender: WorkerThread | None = None  # from start to close
        self._tf = RosTopic(TF, TF_MESSAGE, self._on_tf_wanted)
        self._static = StaticTransforms(lambda: self.submit(self._static.send))
        self._diagnostics = RosTopic("/diagnostics", DIAGNOSTIC_ARRAY, self._on_diagnostics_wanted)
        self._node: RosNode | None = None  # only in the sending thread
        self._names: dict[str, str] = {}  # by source, also those that are gone
        self._sources: dict[str, RosSource] = {}
        self._is_checking = False

    def start(self) -> None:
        """Start the thread that sends, and the one that opens the session."""
        self._sender = WorkerThread("ros2-send")
        self._router.start()

    def _declare_in_thread(self, session: zenoh.Session) -> None:
        sender = self._sender
        if sender is not None:
            with contextlib.suppress(CancelledError):  # the output has just been closed
                sender.submit(functools.partial(self._declare_all, session)).result()

    def _declare_all(self, session: zenoh.Session) -> None:
        """Declare everything on the new session, in the sending thread."""
        self._node = node = RosNode(session, self.settings)
        self._diagnostics.declare(node)
        self._static.declare(node)
        self._declare_tf()
        for source in list(self._sources.values()):
            source.declare(node)

    def _declare_tf(self) -> None:
        """Declare /tf if the streams of any source request tools, in the sending thread.

        If the settings switch it off, nobody can subscribe to it, so that nothing is encoded for it.
        """
        has_tools = any(source.has_tools for source in list(self._sources.values()))
        if self._node is not None and self.settings.tf and has_tools:
            self._tf.declare(self._node)
        else:
            self._tf.undeclare()
        self._on_tf_wanted()

    def _lose_link(self) -> None:
        self._confirmation.lose_link()

    # The sending thread.

    def offer(self, call: Callable[[], None], num_bytes: int = 0) -> bool:
        """Queue a call for the sending thread; return False if its queue is full, or there is no thread."""
        return self._sender is not None and self._sender.offer(call, num_bytes)

    def submit(self, call: Callable[[], None]) -> None:
        """Queue a call for the sending thread, before those that were offered."""
        if self._sender is not None:
            self._sender.submit(call)

    def _check_router(self) -> None:
        self._is_checking = False
        self._confirmation.check()
        for topic in (self._tf, self._diagnostics):
            topic.check_subscribers()
        self._static.check_subscribers()
        for source in list(self._sources.values()):
            source.check_subscribers()

    # Sources.

    def frame_publisher(self, source: str) -> FramePublisher:
        """Return the publisher of a source's frames. Its topics appear with the parameters or the frames."""
        if source not in self._names:
            name = unique_name(ros_name(source, "source"), set(self._names.values()), MAX_PART_CHARS)
            self._names[source] = name
        name = self._names[source]
        base = f"/{self.settings.namespace}/{name}" if self.settings.namespace else f"/{name}"
        tools = self.settings.tools.get(source, {})
        self._sources[source] = publisher = RosSource(
            *(source, base, self._tf, self._static, tools, self._router, self), self._confirmation.of(source)
        )
        self.submit(lambda: None if self._node is None else publisher.declare(self._node))
        return publisher

    def publisher(self, topic: Topic) -> Publisher:
        """Return the publisher of diagnostics for the status; other topics have nothing for ROS."""
        if topic.path == _STATUS:
            names = functools.partial(self.topic_names, topic.source)
            return DiagnosticsPublisher(self._diagnostics, names, self._router, self)
        return super().publisher(topic)

    def publish_parameters(self, source: str, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """Open the topics that belong to the parameters."""
        publisher = self._sources.get(source)
        if publisher is not None:
            had_tools = publisher.has_tools
            publisher.set_parameters(parameters)
            if publisher.has_tools is not had_tools:
                self.submit(self._declare_tf)
        return None

    def topic_names(self, source: str) -> Mapping[str, Mapping[str, str]]:
        """Return the parts of topics for tools and force plates whose labels differ from them."""
        publisher = self._sources.get(source)
        return {} if publisher is None else publisher.names

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` the positions and items that cannot be published."""
        self._sources[source].losses = losses

    def withdraw(self, source: str) -> None:
        """Forget the source; its FramePublisher is closed."""
        self._sources.pop(source, None)
        self.submit(self._declare_tf)

    # What is wanted.

    def watch_wanted(self, source: str, on_change: Callable[[], None]) -> bool:
        """Zenoh reports the subscribers of each topic."""
        self._sources[source].on_wanted_changed = in_this_loop(on_change)
        return True

    def _on_tf_wanted(self) -> None:
        for source in list(self._sources.values()):
            source.update_wanted()

    def _on_diagnostics_wanted(self) -> None:
        for source in list(self._sources.values()):
            source.on_wanted_changed()

    # Life cycle.

    def health(self) -> OutputHealth:
        """Return whether the router is connected, and reads."""
        call_age_s = 0.0 if self._sender is None else self._sender.call_age_s
        health = self._router.health
        silent_s = max(call_age_s, self._confirmation.silent_s)
        if (call_age_s < _HUNG_S and silent_s < SILENT_S) or not health.connected:
            return health
        router = f"the Zenoh router at {self.settings.connect}"
        return OutputHealth(False, f"{router} has read nothing for {silent_s:.0f} s; restart it")

    def maintain(self) -> None:
        """Log whether the router is connected and what was lost with it, and check for subscribers."""
        self._router.maintain()
        losses = {name: source.losses for name, source in self._sources.items()}
        self._confirmation.count_unconfirmed(losses, f"the Zenoh router at {self.settings.connect}")
        if not self._is_checking and not self._router.is_cut_off:
            self._is_checking = True
            self.submit(self._check_router)

    def close(self) -> None:
        """Close the session. The node and its topics disappear from ROS."""
        sender, self._sender = self._sender, None
        if sender is not None:
            # Zenoh never frees what a session had declared when it was closed.
            with contextlib.suppress(TimeoutError, CancelledError):
                sender.submit(self._undeclare_all).result(_UNDECLARE_S)
            sender.close()
        self._router.close()

    def _undeclare_all(self) -> None:
        """Remove all topics, in the sending thread."""
        for source in list(self._sources.values()):
            source.undeclare()
        for topic in (self._tf, self._static, self._diagnostics):
            topic.undeclare()
