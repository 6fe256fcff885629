"""The output that serves RTC3D clients, an RT server for each source that has a port, and its checks."""

import asyncio
import logging
import socket
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from gateway.errors import OutputError, PortError
from gateway.messages.encode import Stamp
from gateway.outputs.adapters.rtc3d.client_filter import FILE, SLOW_CLIENT, SourceState
from gateway.outputs.adapters.rtc3d.live_server import LiveServer
from gateway.outputs.adapters.rtc3d.settings import RTC3D, Rtc3dSettings
from gateway.outputs.contract import (
    CONTROL_OPTION,
    FramePublisher,
    Output,
    OutputHealth,
    QueryService,
    ServerFile,
    ServerParameters,
)
from gateway.outputs.findings import Check, Finding, MessageLoad
from gateway.outputs.frame_output import LoopThread, PortOpener, ServerOutput, in_this_loop
from gateway.outputs.listen_address import from_this_computer, listen_problem
from gateway.rtc3d.commands import Version, encode_command
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import FrameLayout, RawFrame
from gateway.rtc3d.packets import PACKET_HEADER, PACKET_HEADER_BYTES, PacketType, encode_packet
from gateway.runtime.failures import log_fields
from gateway.runtime.losses import Losses

QUEUE_FULL: Final = "queue full"
"""The cause of frames that nobody got because the thread of the clients cannot keep up."""


class Rtc3dPublisher:
    """Hands frames of one source over, while any client wants frames.

    ``offer`` has the thread make a call with the source's server; see LoopThread.offer.
    """

    def __init__(
        self, state: SourceState, offer: Callable[[Callable[[LiveServer], None], int], bool]
    ) -> None:
        self._state = state
        self._offer = offer
        self._is_closed = False

    @property
    def wanted(self) -> bool:
        """Whether any client asks for frames."""
        return self._state.wanted and not self._is_closed

    def wants(self, _components: Collection[ComponentType]) -> bool:
        """See FramePublisher."""
        return self.wanted

    def prepare(self, _layout: FrameLayout, _components: frozenset[ComponentType]) -> bool:
        """See FramePublisher."""
        return self.wanted

    def publish(self, frame: RawFrame, stamp: Stamp, components: frozenset[ComponentType]) -> None:
        """Hand a frame over. Raises OutputError if too many wait."""
        if self._is_closed:
            raise OutputError(
                f"rtc3d: {self._state.source} is closed; ask for a new publisher", cause="closed"
            )
        session = stamp.session
        if self._state.wanted and not self._offer(
            lambda server: server.take(frame, session, components), len(frame.body)
        ):
            raise OutputError(
                f"rtc3d: the frames of {self._state.source} arrive faster than they can be sent to all "
                "clients; let fewer clients connect, or let them ask for fewer frames",
                cause=QUEUE_FULL,
            )

    def close(self) -> None:
        """Close the publisher."""
        self._is_closed = True


_RECORDING: Final = ("recording",)

_log = logging.getLogger(__name__)


class _Served:
    """A source that is served: its port, its server while that is open, and the task that keeps it open."""

    def __init__(self, source: str, port: int) -> None:
        self.port = port
        self.opener = PortOpener(_log, f"{source} to rtc3d", f"port {port} is not open yet")
        self.server: LiveServer | None = None
        self.task: asyncio.Task[None] | None = None
        self.closed = asyncio.Event()

    async def stop(self) -> None:
        """Close the port."""
        if self.task is not None:
            self.task.cancel()
            await self.closed.wait()


class Rtc3dOutput(ServerOutput):
    """Serves RTC3D clients in a thread of its own. They share the gateway's session with each server."""

    name = "rtc3d"
    drop_causes = (SLOW_CLIENT, QUEUE_FULL, FILE)
    close_s = 3.0

    def __init__(self, settings: Rtc3dSettings) -> None:
        super().__init__()
        self.settings: Rtc3dSettings = settings
        self._states: dict[str, SourceState] = {}
        self._announced: set[str] = set()
        self._served: dict[str, _Served] = {}  # by source; replaced when the settings change
        self._closing: list[_Served] = []  # former ones, which may still have a port that is wanted again
        self._on_wanted: dict[str, Callable[[], None]] = {}
        self._queries: QueryService | None = None
        self._loop: asyncio.AbstractEventLoop | None = None  # of the gateway

    # The core -------------------------------------------------------------------------------

    def _serve(self, thread: LoopThread) -> None:  # noqa: ARG002 - see _open_ports
        self._open_ports()
        for source in self.settings.ports.keys() - self._announced:
            _log.warning("rtc3d.ports has a port for %s, which is no source; correct its name", source)

    def frame_publisher(self, source: str) -> FramePublisher:
        """Return a publisher of whole frames."""
        return Rtc3dPublisher(self._state(source), partial(self._offer_to, source))

    def health(self) -> OutputHealth:
        """Return whether clients can connect to all sources that have a port."""
        if self._thread is None or self._is_closed:
            return OutputHealth(False, "rtc3d is not open")
        problems = [each.opener.problem for each in list(self._served.values()) if each.opener.problem]
        return OutputHealth(not problems, "; ".join(problems))

    def _state(self, source: str) -> SourceState:
        if source not in self._states:
            self._states[source] = SourceState(source)
        return self._states[source]

    def _offer_to(self, source: str, call: Callable[[LiveServer], None], num_bytes: int = 0) -> bool:
        """Have the thread make a call with the source's server, if its port is open then; see ``_offer``."""
        return self._offer(partial(self._call, source, call), num_bytes)

    def _call(self, source: str, call: Callable[[LiveServer], None]) -> None:
        served = self._served.get(source)
        if served is not None and served.server is not None:
            call(served.server)

    # Maintenance ----------------------------------------------------------------------------

    def maintain(self) -> None:
        """Let the thread count what slow clients have lost."""
        for source in list(self._served):
            self._offer_to(source, LiveServer.maintain)

    def is_configured_like(self, other: Output) -> bool:
        """Any settings can be taken over."""
        return isinstance(other, Rtc3dOutput)

    def take_over(self, other: Output) -> bool:
        """Apply other settings. Clients of sources whose address stays the same notice nothing."""
        assert isinstance(other, Rtc3dOutput)  # noqa: S101 - is_configured_like says so
        before, self.settings = self.settings, other.settings
        if before == self.settings:
            return False
        if before.host != self.settings.host:
            self._close_ports(list(self._served))
        self._open_ports()
        return True

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` what slow clients do not get."""
        self._state(source).losses = losses

    def watch_wanted(self, source: str, on_change: Callable[[], None]) -> bool:
        """Frames are wanted while any client asks for them."""
        self._loop = asyncio.get_running_loop()
        self._on_wanted[source] = in_this_loop(on_change)
        return True

    # Sources --------------------------------------------------------------------------------

    def announce(self, source: str) -> None:
        """Open the port of ``source``."""
        self._announced.add(source)
        self._open_ports()

    def withdraw(self, source: str) -> None:
        """Close the port of ``source`` and the connections of its clients."""
        self._announced.discard(source)
        self._open_ports()

    def show_streaming(self, source: str, is_streaming: bool) -> None:
        """Let clients know when frames end."""
        self._state(source).is_streaming = is_streaming
        self._offer_to(source, LiveServer.maintain)

    def show_measurement(self, source: str, is_running: bool | None) -> None:
        """Let clients know when a measurement ends."""
        self._state(source).is_measuring = is_running
        self._offer_to(source, LiveServer.maintain)

    def publish_parameters(self, source: str, parameters: ServerParameters) -> None:
        """Serve these parameters to clients that ask for them."""
        self._state(source).parameters = parameters
        self._offer_to(source, LiveServer.maintain)

    def announce_file(self, source: str, file: ServerFile) -> None:
        """Pass a C3D file on to the clients."""
        if self._thread is not None:
            self._thread.run(self._send_file(source, file.path))  # not _offer, which can be refused

    async def _send_file(self, source: str, path: Path) -> None:
        self._call(source, lambda server: server.send_file(path))

    # Recordings -----------------------------------------------------------------------------

    def serve_queries(self, service: QueryService) -> None:
        """Use ``service`` for clients that start and stop recordings."""
        self._queries = service

    async def _control_recording(self, source: str, start: bool, options: str) -> str:
        """Ask the gateway's event loop; return the server's reply or "". In the thread. Raises QueryError."""
        assert self._loop is not None  # noqa: S101 - there is a source, so watch_wanted was called
        assert self._queries is not None  # noqa: S101 - the gateway has set it before ``start``
        query = {CONTROL_OPTION: "start" if start else "stop"}
        if start and options:
            query["options"] = options
        answering = self._queries.answer(source, _RECORDING, query)
        answer = await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(answering, self._loop))
        return str(answer.attachment.get("reply", ""))

    # Ports ----------------------------------------------------------------------------------

    def _open_ports(self) -> None:
        """Open the ports of the sources that are announced, and close others."""
        ports = {source: port for source, port in self.settings.ports.items() if source in self._announced}
        self._close_ports(
            [source for source, served in self._served.items() if ports.get(source) != served.port]
        )
        if self._thread is None:
            return
        max_clients = self.settings.max_clients
        for source, port in ports.items():
            if source not in self._served:
                served = self._served[source] = _Served(source, port)
                self._closing = [former for former in self._closing if not former.closed.is_set()]
                self._thread.run(self._keep_open(self._state(source), served, tuple(self._closing)))
            self._offer_to(source, lambda server: server.set_max_clients(max_clients))

    def _close_ports(self, sources: list[str]) -> None:
        for source in sources:
            served = self._served.pop(source)
            if self._thread is not None:
                self._closing.append(served)
                self._thread.run(served.stop())

    async def _stop(self) -> None:
        await asyncio.gather(*(served.stop() for served in self._served.values()))

    async def _keep_open(self, state: SourceState, served: _Served, closing: tuple[_Served, ...]) -> None:
        """Listen on the port until stopped. Wait for those that are ``closing`` first."""
        served.task = asyncio.current_task()
        try:
            for former in closing:
                await former.closed.wait()
            host, port = self.settings.host, served.port
            listen = partial(self._listen, state, host, port)
            with log_fields(source=state.source):
                server = served.server = await served.opener.open(
                    listen, f"clients can connect to {host}, port {port}"
                )
                try:
                    await asyncio.Event().wait()  # until cancelled
                finally:
                    served.server = None
                    await server.close()
        finally:
            served.closed.set()

    async def _listen(self, state: SourceState, host: str, port: int) -> LiveServer:
        on_wanted = self._on_wanted.get(state.source, lambda: None)
        server = LiveServer(state, host, port, self.settings.max_clients, on_wanted, self._control_recording)
        try:
            await server.listen()
        except PortError as error:
            raise PortError(f"RTC3D clients cannot connect: {error}") from error
        return server


_MAX_REPLY_BYTES: Final = 64 * 1024

_SOURCES, _PORTS = (Check("rtc3d", name) for name in RTC3D.checks)


def check_rtc3d(
    settings: Rtc3dSettings, sources: Sequence[str], _loads: Sequence[MessageLoad], seconds: float
) -> list[Finding]:
    """Check that each port belongs to a source, and is free or has the gateway's own RT server."""
    ports = [_check_port(settings.host, source, port, seconds) for source, port in settings.ports.items()]
    return [_check_sources(settings, sources), *(ports or [_PORTS.not_tested("rtc3d.ports is empty")])]


def _check_sources(settings: Rtc3dSettings, sources: Sequence[str]) -> Finding:
    unknown = [source for source in settings.ports if source not in sources]
    if unknown:
        return _SOURCES.warning(
            f"rtc3d.ports has a port for {', '.join(unknown)}, which is no source",
            f"Correct the name; the sources are {', '.join(sources)}.",
        )
    missing = [source for source in sources if source not in settings.ports]
    if missing:
        return _SOURCES.note(
            f"RTC3D clients cannot connect to {', '.join(missing)}",
            "If they should, add a port in rtc3d.ports.",
        )
    return _SOURCES.passing("each source has a port for RTC3D clients")


def _check_port(host: str, source: str, port: int, seconds: float) -> Finding:
    place = f"{host}, port {port} (for {source})"
    problem = listen_problem(host, port)
    if not problem:
        return _PORTS.passing(f"{place} is free")
    if _is_rt_server(host, port, seconds):
        return _PORTS.passing(f"an RT server answers on {place}: the gateway, if it runs")
    return _PORTS.failing(
        f"cannot listen on {place}: {problem}",
        f"Choose another port in rtc3d.ports.{source}, correct rtc3d.host, or stop the program that has it.",
    )


def _is_rt_server(host: str, port: int, seconds: float) -> bool:
    """Return whether a server on this port answers a command of the protocol."""
    command = encode_packet(PacketType.COMMAND, encode_command(Version()))
    try:
        with socket.create_connection((from_this_computer(host), port), timeout=seconds) as tcp:
            tcp.sendall(command)
            header = tcp.recv(PACKET_HEADER_BYTES, socket.MSG_WAITALL)
            if len(header) < PACKET_HEADER_BYTES:
                return False
            size, packet_type = PACKET_HEADER.unpack(header)
            if packet_type not in {PacketType.ERROR, PacketType.COMMAND}:
                return False
            if not PACKET_HEADER_BYTES <= size <= _MAX_REPLY_BYTES:
                return False
            # The whole reply, because closing a connection with unread bytes resets it.
            tcp.recv(size - PACKET_HEADER_BYTES, socket.MSG_WAITALL)
    except OSError:
        return False
    return True
