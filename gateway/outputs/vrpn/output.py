"""The output that serves tools as VRPN trackers."""

import asyncio
from collections.abc import Callable, Mapping
from typing import Final

from gateway.losses import Losses
from gateway.messages.topics import Topic
from gateway.outputs.contract import FramePublisher, Output, Publisher, ServerParameters
from gateway.outputs.event_loop import in_this_loop
from gateway.outputs.loop_thread import LoopThread
from gateway.outputs.no_topics import IgnoringPublisher
from gateway.outputs.status import OutputHealth
from gateway.outputs.vrpn.publisher import VrpnPublisher
from gateway.outputs.vrpn.server import VrpnServer
from gateway.outputs.vrpn.settings import VrpnSettings
from gateway.rtc3d.components import ComponentType

_CLOSING_S: Final = 1.0


class VrpnOutput(Output):
    """A VRPN server in a thread of its own, and a publisher for each source."""

    name = "vrpn"
    drop_causes = ("slow client", "queue full", "unknown unit", "too many tools")

    def __init__(self, settings: VrpnSettings) -> None:
        self.settings = settings
        self._server = VrpnServer(settings.host, settings.port, settings.tracker_names, self._wanted_changed)
        self._publishers: dict[str, VrpnPublisher] = {}  # by source
        self._thread: LoopThread | None = None
        self._on_wanted: dict[str, Callable[[], None]] = {}  # by source

    def start(self) -> None:
        """Start to listen."""
        self._thread = LoopThread(self.name)
        self._thread.run(self._server.serve())
        for publisher in self._publishers.values():
            publisher.name_trackers()

    def _offer(self, call: Callable[[], None], num_bytes: int) -> bool:
        """See LoopThread.offer."""
        return self._thread is not None and self._thread.offer(call, num_bytes)

    def publisher(self, topic: Topic) -> Publisher:  # noqa: ARG002 - of no topic
        """Return a publisher that does nothing: VRPN has no status and no clock."""
        return IgnoringPublisher()

    def frame_publisher(self, source: str) -> FramePublisher:
        """Return a new publisher of the frames of ``source``, whose tools become trackers."""
        publisher = VrpnPublisher(source, self._server, self._offer)
        self._publishers[source] = publisher
        publisher.name_trackers()
        return publisher

    def watch_wanted(self, source: str, on_change: Callable[[], None]) -> bool:
        """Frames are wanted while a client is connected."""
        self._on_wanted[source] = in_this_loop(on_change)
        return True

    def _wanted_changed(self) -> None:
        """Report a change for every source; called in the server's thread."""
        for on_change in list(self._on_wanted.values()):
            on_change()

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` the poses that slow clients miss."""
        self._publishers[source].losses = losses

    def publish_parameters(self, source: str, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """Name the trackers by the labels of the tools."""
        if source in self._publishers:
            self._publishers[source].set_parameters(parameters)
        return None

    def topic_names(self, source: str) -> Mapping[str, Mapping[str, str]]:
        """Return the names of trackers that differ from the names of their tools."""
        trackers = self._server.trackers.of_source(source)
        names = {tool: tracker.name for tool, tracker in trackers.items() if tracker is not None}
        changed = {tool: name for tool, name in names.items() if name != tool}
        return {ComponentType.TOOLS.key: changed} if changed else {}

    def withdraw(self, source: str) -> None:
        """Forget a source, whose publisher is closed."""
        self._publishers.pop(source, None)
        self._on_wanted.pop(source, None)

    def health(self) -> OutputHealth:
        """Return whether clients can connect."""
        problem = self._server.problem
        return OutputHealth(not problem, problem)

    def is_configured_like(self, other: Output) -> bool:
        """Return whether ``other`` has the same settings."""
        return isinstance(other, VrpnOutput) and self.settings == other.settings

    def close(self) -> None:
        """Disconnect all clients and stop listening."""
        if self._thread is not None:
            self._thread.close(self._server.close, _CLOSING_S)
