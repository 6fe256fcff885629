"""The output that serves tools as VRPN trackers, and what the doctor checks of it."""

import asyncio
import socket
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Final

from gateway.errors import OutputError, system_reason
from gateway.messages.descriptions.labels import describe
from gateway.messages.descriptions.source_frame import unknown_unit_text
from gateway.messages.encode import Stamp
from gateway.outputs.adapters.vrpn.protocol import COOKIE_BYTES, COOKIE_START, encode_pose
from gateway.outputs.adapters.vrpn.server import VrpnServer, bind, logger
from gateway.outputs.adapters.vrpn.settings import VRPN, VrpnSettings
from gateway.outputs.adapters.vrpn.trackers import MAX_TRACKERS, Tracker
from gateway.outputs.contract import FramePublisher, OutputHealth, ServerParameters
from gateway.outputs.findings import Check, Finding, MessageLoad
from gateway.outputs.frame_output import LoopThread, ServerOutput, in_this_loop
from gateway.outputs.listen_address import from_this_computer, is_loopback
from gateway.rtc3d.components import ComponentType, num_described_items
from gateway.rtc3d.frames import FrameLayout, RawFrame
from gateway.runtime.losses import Losses

MAX_TOOLS: Final = 256
"""How many tools of a source can be trackers, and how many poses of a frame are sent, at most."""

_NO_PARAMETERS: Final = ServerParameters(b"", 0, 0)


class VrpnPublisher:
    """Takes whole frames of one source and sends the poses of its tools.

    ``offer`` is LoopThread.offer of the server's thread.

    Methods without an underscore are for the gateway's event loop, the others run in the server's thread.
    """

    def __init__(
        self, source: str, server: VrpnServer, offer: Callable[[Callable[[], None], int], bool]
    ) -> None:
        self.losses = Losses(logger, f"{source} to vrpn")
        """Counts the poses that are lost."""
        self._source = source
        self._server = server
        self._offer = offer
        self._parameters = _NO_PARAMETERS
        self._shown: ServerParameters | None = None  # those that the trackers are named by

    @property
    def wanted(self) -> bool:
        """Whether a client is connected."""
        return self._server.has_clients

    def set_parameters(self, parameters: ServerParameters) -> None:
        """Use other parameters for the frames after this call."""
        self._parameters = parameters
        self.name_trackers()

    def name_trackers(self) -> None:
        """Name the trackers by the newest parameters. If too many calls wait, the next frame does so."""
        self._offer(partial(self._show, self._parameters, 0), len(self._parameters.xml))

    def wants(self, components: Collection[ComponentType]) -> bool:
        """Return whether a client is connected and the tools are among these components."""
        return self.wanted and ComponentType.TOOLS in components

    def prepare(self, layout: FrameLayout, components: frozenset[ComponentType]) -> bool:
        """Return whether a client is connected and frames of ``layout`` have tools."""
        return self.wants(components) and bool(_tool_indices(layout))

    def publish(
        self,
        frame: RawFrame,
        stamp: Stamp,
        components: frozenset[ComponentType],  # noqa: ARG002 - see ``prepare``
    ) -> None:
        """Hand over a frame with tools. Raises OutputError if too many wait, or if the unit is unknown."""
        if not self.wanted:
            return
        parameters = self._parameters
        if parameters.frame.metres_per_unit is None:
            raise OutputError(unknown_unit_text(parameters.parsed), cause="unknown unit")
        call = partial(self._send, parameters, frame, stamp)
        if not self._offer(call, len(frame.body)):
            raise OutputError("frames arrive faster than they can be sent", cause="queue full")

    def close(self) -> None:
        """Remove the source's trackers."""
        self._offer(partial(self._server.trackers.remove, self._source), 0)

    def _show(self, parameters: ServerParameters, num_tools: int) -> None:
        """Name the trackers of ``num_tools`` tools, or of more if the parameters have more."""
        num_labels = num_described_items(parameters.parsed, ComponentType.TOOLS)
        num_trackers = min(max(num_labels, num_tools), MAX_TOOLS)
        labels = describe(ComponentType.TOOLS, parameters.parsed, num_trackers).labels
        self._server.trackers.set_tools(self._source, labels)
        self._server.describe_trackers()
        self._shown = parameters

    def _send(self, parameters: ServerParameters, frame: RawFrame, stamp: Stamp) -> None:
        num_items = num_with_tracker = num_poses = 0
        messages: list[bytes] = []
        for index in _tool_indices(frame.layout):  # usually one
            items = frame.component(index).items()
            num_items += len(items)
            if self._shown is not parameters or min(len(items), MAX_TOOLS) > len(self._trackers):
                self._show(parameters, len(items))
            poses = parameters.frame.poses(items[: MAX_TOOLS - num_poses])
            num_poses += len(poses)
            for tracker, pose in zip(self._trackers, poses, strict=False):
                num_with_tracker += tracker is not None
                if tracker is not None and pose is not None:
                    messages.append(encode_pose(tracker.number, stamp.capture_utime, pose))
        if num_with_tracker < num_items:
            num_lost = num_items - num_with_tracker
            self.losses.lost(
                "too many tools",
                f"{num_lost} tools have no tracker: there can be {MAX_TOOLS} of a source and {MAX_TRACKERS} "
                "of all; remove tools that are not used from the server",
                messages=num_lost,
            )
        slow = self._server.send(b"".join(messages)) if messages else []
        if slow:
            self.losses.lost(
                "slow client",
                f"poses for {slow[0]} are lost, because it does not read them fast enough; look at that "
                "program",
                messages=len(messages) * len(slow),
            )

    @property
    def _trackers(self) -> Collection[Tracker | None]:
        return self._server.trackers.of_source(self._source).values()


def _tool_indices(layout: FrameLayout) -> list[int]:
    """Return which components of a frame have tools."""
    components = enumerate(layout.components)
    return [index for index, each in components if each.type is ComponentType.TOOLS and each.num_items]


class VrpnOutput(ServerOutput):
    """A VRPN server in a thread of its own, and a publisher for each source."""

    name = "vrpn"
    drop_causes = ("slow client", "queue full", "unknown unit", "too many tools")

    def __init__(self, settings: VrpnSettings) -> None:
        super().__init__()
        self.settings: VrpnSettings = settings
        self._server = VrpnServer(settings.host, settings.port, settings.tracker_names, self._wanted_changed)
        self._publishers: dict[str, VrpnPublisher] = {}  # by source
        self._on_wanted: dict[str, Callable[[], None]] = {}  # by source

    def _serve(self, thread: LoopThread) -> None:
        thread.run(self._server.serve())
        for publisher in self._publishers.values():
            publisher.name_trackers()

    async def _stop(self) -> None:
        await self._server.close()

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
        return OutputHealth(not self._server.problem, self._server.problem)


_TIMEOUT_S: Final = 2.0

_PORT, _ACCESS = (Check("vrpn", name) for name in VRPN.checks)


def check_vrpn(
    settings: VrpnSettings, _sources: Sequence[str], _loads: Sequence[MessageLoad], _seconds: float
) -> list[Finding]:
    """Check that the port can be used, and say who can connect."""
    access = _ACCESS.passing("only programs on this computer can connect")
    if not is_loopback(settings.host):
        access = _ACCESS.note(
            f"any computer that reaches {settings.host} can connect: VRPN has no password and no encryption",
            "Open the port in the firewall for the computers that need it, or set vrpn.host to 127.0.0.1.",
        )
    return [_check_port(settings), access]


def _check_port(settings: VrpnSettings) -> Finding:
    where = f"{settings.host}, port {settings.port}"
    try:
        for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
            bind(socket.getaddrinfo(settings.host, settings.port, type=kind), kind).close()
    except OSError as error:
        if _is_served(settings):
            return _PORT.passing(f"a VRPN server answers on {where}")
        return _PORT.failing(
            f"cannot listen on {where}: {system_reason(error)}, and no VRPN server answers there",
            "Stop the program that uses the port, or set vrpn.host and vrpn.port to an address of this "
            "computer and a free port.",
        )
    return _PORT.passing(f"TCP and UDP are free on {where}; no gateway serves VRPN there now")


def _is_served(settings: VrpnSettings) -> bool:
    """Return whether a VRPN server answers on the port."""
    address = (from_this_computer(settings.host), settings.port)
    try:
        with socket.create_connection(address, _TIMEOUT_S) as connection:
            connection.settimeout(_TIMEOUT_S)
            cookie = connection.recv(COOKIE_BYTES, socket.MSG_WAITALL)
    except OSError:
        return False
    return cookie.startswith(COOKIE_START)
