"""The VRPN server: accepts clients over TCP, calls back those that ask by UDP, and sends poses to all.

Everything here runs in the event loop of the output's own thread, unless it says otherwise. Clients are
untrusted: their number, how fast they connect, and how much is read from them and kept for them is bounded.
"""

import asyncio
import contextlib
import logging
import socket
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, Final, cast

from gateway.errors import PeerError, PortError
from gateway.messages.host_time import now_utime
from gateway.outputs.adapters.vrpn.protocol import (
    COOKIE,
    TYPE_DESCRIPTIONS,
    ClientReader,
    callback_port,
    describe_tracker,
    encode_pong,
)
from gateway.outputs.adapters.vrpn.trackers import TrackerNames, Trackers
from gateway.outputs.frame_output import PortOpener
from gateway.runtime.failures import DefectLog, EventLog
from gateway.runtime.server_limits import Clients, ServerLimits, notice_vanished
from gateway.runtime.token_bucket import TokenBucket

LIMITS: Final = ServerLimits(clients=64, handshakes=16, unread_bytes=256 * 1024)
"""256 KiB are a second of 30 tools at 100 Hz. A client sends names, and pings until they are answered."""

_READ_BYTES_PER_S: Final = 128 * 1024.0
_READ_BURST_BYTES: Final = 1024 * 1024.0
"""How much of all clients together is read, so that 64 of them cannot keep the thread from sending poses."""

_READ_PAUSE_S: Final = 0.25
_ACCEPT_PAUSE_S: Final = 0.1
_BACKLOG: Final = 64
"""How many clients wait in the kernel to be accepted."""

logger = logging.getLogger(__name__)


class VrpnServer:
    """Serves ``trackers`` on a TCP and a UDP port of the same number.

    ``on_wanted_changed`` is called when ``has_clients`` has changed.
    """

    def __init__(
        self,
        host: str,
        port: int,
        names: TrackerNames,
        on_wanted_changed: Callable[[], None] = lambda: None,
    ) -> None:
        self.trackers = Trackers(names)
        self.read_budget = TokenBucket(_READ_BYTES_PER_S, _READ_BURST_BYTES)
        """How many bytes of all clients together may be read."""
        self.clients: Clients[Client] = Clients(LIMITS, Client.abort)
        self._on_wanted_changed = on_wanted_changed
        self._host = host
        self._port = port
        self._serving: asyncio.Task[None] | None = None
        self._accepts = TokenBucket(LIMITS.accepts_per_s, LIMITS.accepts_burst)
        self._opener = PortOpener(
            logger,
            "vrpn",
            f"it does not listen on {host}, port {port} yet; if this lasts, check vrpn.host and the name "
            "server (DNS)",
        )
        self.events = EventLog(logger, "vrpn")
        self._defects = DefectLog(logger, "vrpn")

    @property
    def problem(self) -> str:
        """Why clients cannot connect, and what to do; "" if they can."""
        return self._opener.problem

    @property
    def has_clients(self) -> bool:
        """Whether a client is connected that has shown that it speaks VRPN. Any thread may ask."""
        return bool(self.clients.served)

    def send(self, poses: bytes) -> list[str]:
        """Send messages with poses to all clients. Return the names of those that miss them."""
        return [client.name for client in tuple(self.clients.served) if not client.send(poses)]

    def describe_trackers(self) -> None:
        """Describe trackers that are new to all clients."""
        for client in tuple(self.clients.served):
            client.describe_trackers()

    # Listening ------------------------------------------------------------------------------

    async def serve(self) -> None:
        """Accept clients until ``close``. If the port cannot be used, try again."""
        self._serving = asyncio.current_task()
        tcp, udp = await self._opener.open(
            self._bind_both, f"trackers are served on {self._host}, port {self._port}"
        )
        with tcp, udp:
            requests = CallbackRequests(udp, self._call_back, self.events, self._port)
            try:
                while True:
                    await self._accept(tcp)
            finally:
                requests.close()

    async def _bind_both(self) -> list[socket.socket]:
        """Return the sockets for TCP and UDP. Raises PortError."""
        loop = asyncio.get_running_loop()
        with contextlib.ExitStack() as opened:
            sockets = []
            for kind, protocol in ((socket.SOCK_STREAM, "TCP"), (socket.SOCK_DGRAM, "UDP")):
                try:
                    addresses = await loop.getaddrinfo(self._host, self._port, type=kind)
                    sockets.append(opened.enter_context(bind(addresses, kind)))
                except OSError as error:
                    raise PortError(
                        f"cannot listen on {self._host}, {protocol} port {self._port}: "
                        f"{error.strerror or error}; stop the program that uses the port, or set vrpn.host "
                        "and vrpn.port to an address of this computer and a free port"
                    ) from error
            opened.pop_all()
            return sockets

    async def _accept(self, tcp: socket.socket) -> None:
        """Accept one client. Those that come too fast wait in the kernel, or are refused there."""
        while not self._accepts.try_take():  # noqa: ASYNC110 - time makes it true, not an event
            await asyncio.sleep(_ACCEPT_PAUSE_S)
        loop = asyncio.get_running_loop()
        try:
            connection, _ = await loop.sock_accept(tcp)
            await loop.connect_accepted_socket(lambda: Client(self), connection)
        except OSError as error:
            # The client has gone, or the process has too many open files.
            text = f"a client could not be accepted: {error.strerror or error}"
            self.events.log(logging.WARNING, text, "not accepted")
            await asyncio.sleep(_ACCEPT_PAUSE_S)
        except Exception as defect:  # noqa: BLE001 - the next client is accepted nevertheless
            self._defects.log(defect)
            await asyncio.sleep(_ACCEPT_PAUSE_S)

    async def _call_back(self, host: str, port: int) -> None:
        client = Client(self)
        try:
            await asyncio.get_running_loop().create_connection(lambda: client, host, port)
        except asyncio.CancelledError:
            # uvloop does not call connection_lost if this comes just after connection_made.
            self.client_closed(client)
            raise

    async def close(self) -> None:
        """Stop listening and disconnect all clients."""
        if self._serving is not None:
            self._serving.cancel()
            await asyncio.wait([self._serving])
        self._opener.problem = "the VRPN server is closed; start the gateway again"
        for client in self.clients:
            client.abort()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self.clients.limits.close_s):
                while self.clients:  # noqa: ASYNC110 - until the loop has closed their sockets
                    await asyncio.sleep(0)

    # For clients ----------------------------------------------------------------------------

    def has_room_for(self, client: "Client") -> bool:
        """Return whether one more client can be served; if not, it is disconnected."""
        if self.clients.is_full:
            text = f"{client.name} is refused: {self.clients.limits.clients} clients are connected"
            self.events.log(logging.WARNING, text, "refused")
            client.abort()
        return not self.clients.is_full

    def client_ready(self, client: "Client") -> None:
        """Serve a client that has shown that it speaks VRPN."""
        if not self.has_room_for(client):
            return
        self.clients.serve(client)
        num_clients = len(self.clients.served)
        if num_clients == 1:
            self._on_wanted_changed()
        self.events.log(logging.INFO, f"{client.name} is connected; clients now: {num_clients}", "connected")

    def client_closed(self, client: "Client") -> None:
        """Remove a connection that has ended."""
        was_served = client in self.clients.served
        self.clients.close(client)
        if was_served:
            num_clients = len(self.clients.served)
            if not num_clients:
                self._on_wanted_changed()
            text = f"{client.name} has disconnected; clients now: {num_clients}"
            self.events.log(logging.INFO, text, "closed")


def bind(addresses: Sequence[tuple[Any, ...]], kind: socket.SocketKind) -> socket.socket:
    """Return a socket bound to the first of ``addresses``, which are results of getaddrinfo.

    IPv4 comes first, because libvrpn speaks nothing else. Raises OSError.
    """
    family, _, _, _, address = min(addresses, key=lambda each: each[0] != socket.AF_INET)
    bound = socket.socket(family, kind)
    try:
        bound.setblocking(False)
        if kind is socket.SOCK_STREAM:  # the port may have old connections that are not over yet
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
        if kind is socket.SOCK_STREAM:
            bound.listen(_BACKLOG)
    except OSError:
        bound.close()
        raise
    return bound


class Client(asyncio.BufferedProtocol):
    """One client's TCP connection: exchanges cookies, describes the trackers, and sends their poses.

    While a client does not read, it gets no poses. Trackers are described before their first pose, and
    whenever they change.
    """

    name = "a client"
    """The client's address and port."""

    def __init__(self, owner: VrpnServer) -> None:
        self.is_ready = False
        """Whether the client has sent its cookie."""
        self._owner = owner
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport
        self._received = bytearray(owner.clients.limits.read_bytes)
        self._reader = ClientReader()
        self._budget = owner.clients.limits.new_received_budget()
        self._is_full = False  # whether as much as may wait does so
        self._timeout: asyncio.TimerHandle | None = None
        self._described: dict[int, str] = {}  # the names of the trackers by number, as the client knows them
        self._version = -1  # of the trackers that were described last

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Send the cookie: both sides do so without waiting for the other (asyncio.BaseProtocol)."""
        self._transport = cast(asyncio.Transport, transport)
        address = transport.get_extra_info("peername")
        if address:  # None if the connection has ended already
            self.name = f"{address[0]}:{address[1]}"
        if not self._owner.has_room_for(self):
            return
        self._owner.clients.open(self)
        limits = self._owner.clients.limits
        notice_vanished(cast(socket.socket, transport.get_extra_info("socket")), limits)
        self._transport.set_write_buffer_limits(high=limits.unread_bytes_each)
        self._transport.write(COOKIE)
        self._set_timeout(
            limits.handshake_s,
            f"it sent no VRPN cookie within {limits.handshake_s:g} s: is it a VRPN client?",
        )

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - why does not matter
        """See asyncio.BaseProtocol."""
        self._clear_timeout()
        self._owner.client_closed(self)

    def abort(self) -> None:
        """Close the connection at once."""
        self._transport.abort()

    # Reading --------------------------------------------------------------------------------

    def get_buffer(self, sizehint: int) -> bytearray:  # noqa: ARG002 - the size is fixed
        """See asyncio.BufferedProtocol."""
        return self._received

    def buffer_updated(self, nbytes: int) -> None:
        """Answer pings of trackers that there are (asyncio.BufferedProtocol)."""
        if self._transport.is_closing():
            return
        try:
            pinged = self._reader.receive(bytes(self._received[:nbytes]))
        except PeerError as error:
            self._fail(str(error))
            return
        if self._reader.has_cookie and not self.is_ready:
            self.is_ready = True
            self._clear_timeout()
            self._transport.write(TYPE_DESCRIPTIONS)
            self.describe_trackers()
            self._owner.client_ready(self)
        # A client repeats a ping until it is answered.
        trackers = filter(None, map(self._owner.trackers.by_name.get, pinged))
        pongs = b"".join(encode_pong(tracker.number, now_utime()) for tracker in trackers)
        if pongs and not self._is_full:
            self.describe_trackers()
            self._transport.write(pongs)
        self._budget.take(nbytes)
        self._owner.read_budget.take(nbytes)
        self._read_or_wait()

    def _read_or_wait(self) -> None:
        """Read on if the budgets allow it, or wait until they do."""
        if self._transport.is_closing():
            return
        if self._budget.left > 0 and self._owner.read_budget.left > 0:
            self._transport.resume_reading()
        else:
            self._transport.pause_reading()
            self._loop.call_later(_READ_PAUSE_S, self._read_or_wait)

    # Writing --------------------------------------------------------------------------------

    def describe_trackers(self) -> None:
        """Describe those trackers to the client that it does not know yet, unless it does not read."""
        trackers = self._owner.trackers
        if self._is_full or self._transport.is_closing() or self._version == trackers.version:
            return
        self._version = trackers.version
        current = trackers.by_name.values()
        new = [tracker for tracker in current if self._described.get(tracker.number) != tracker.name]
        self._described.update((tracker.number, tracker.name) for tracker in new)
        self._transport.write(b"".join(describe_tracker(*tracker) for tracker in new))

    def send(self, poses: bytes) -> bool:
        """Send messages with poses; return False if the client does not read. It must be ready."""
        if self._is_full:
            return False
        if not self._transport.is_closing():
            self.describe_trackers()
            self._transport.write(poses)
        return True

    def pause_writing(self) -> None:
        """Send no more poses: the client does not read (asyncio.BaseProtocol)."""
        self._is_full = True
        unread_s = self._owner.clients.limits.unread_s
        self._set_timeout(unread_s, f"it has read nothing for {unread_s:g} s")

    def resume_writing(self) -> None:
        """Send poses again: the client has read most of what was sent (asyncio.BaseProtocol)."""
        self._is_full = False
        self._clear_timeout()

    # The end --------------------------------------------------------------------------------

    def _set_timeout(self, timeout_s: float, text: str) -> None:
        self._clear_timeout()
        self._timeout = self._loop.call_later(timeout_s, self._fail, text)

    def _clear_timeout(self) -> None:
        if self._timeout is not None:
            self._timeout.cancel()
            self._timeout = None

    def _fail(self, text: str) -> None:
        self._owner.events.log(logging.INFO, f"{self.name} is disconnected: {text}", "failed")
        self._transport.abort()


MAX_CALLS: Final = 16
"""To how many clients the server tries to connect at the same time."""

MAX_CALLS_PER_HOST: Final = 4
"""So many of them may be to one computer, so that it leaves room for others."""

_CALL_TIMEOUT_S: Final = 2.0  # then the client asks again
_CALLS_PER_S: Final = 20.0
"""Nobody can use the server to send more than this many connections to another computer."""

_DATAGRAMS_TOGETHER: Final = 20
_PAUSE_S: Final = 0.1
"""How many datagrams are read at once, and how long none is read after that."""

_MAX_DATAGRAM_BYTES: Final = 512  # an address and a port

CallBack = Callable[[str, int], Awaitable[None]]
"""Connects to a client's address and TCP port. Raises OSError."""


class CallbackRequests:
    """Reads requests from a UDP socket and calls back those who sent them.

    That is how libvrpn connects unless the address begins with tcp:. Anybody can send such a datagram, with
    any sender's address. So the server connects only to the address that the datagram came from, never to
    ports of system services, and only to a few addresses at a time; datagrams beyond a rate are not read. A
    client repeats its request every 2 s. ``own_port`` is the server's own port, to which it must not connect.
    """

    def __init__(self, udp: socket.socket, call_back: CallBack, events: EventLog, own_port: int) -> None:
        self._udp = udp
        self._call_back = call_back
        self._events = events
        self._own_port = own_port
        self._loop = asyncio.get_running_loop()
        self._calls = TokenBucket(_CALLS_PER_S)
        self._in_progress: dict[tuple[str, int], asyncio.Task[None]] = {}
        self._pause: asyncio.TimerHandle | None = None
        self._read_on()

    def close(self) -> None:
        """Stop reading and calling; the socket stays open."""
        if self._pause is not None:
            self._pause.cancel()
        self._loop.remove_reader(self._udp)
        for task in self._in_progress.values():
            task.cancel()

    def _read_on(self) -> None:
        self._pause = None
        self._loop.add_reader(self._udp, self._read)

    def _read(self) -> None:
        """Read what has arrived, then pause: the kernel drops what its buffer cannot hold meanwhile."""
        for _ in range(_DATAGRAMS_TOGETHER):
            try:
                datagram, address = self._udp.recvfrom(_MAX_DATAGRAM_BYTES)
            except OSError:  # there is none, or the network reports an error about an earlier one
                break
            self._receive(datagram, address[0])
        self._loop.remove_reader(self._udp)
        self._pause = self._loop.call_later(_PAUSE_S, self._read_on)

    def _receive(self, datagram: bytes, host: str) -> None:
        port = callback_port(datagram)
        if port is None or port == self._own_port or (host, port) in self._in_progress:
            return
        num_of_host = sum(other == host for other, _ in self._in_progress)
        if len(self._in_progress) >= MAX_CALLS or num_of_host >= MAX_CALLS_PER_HOST:
            return
        if self._calls.try_take():
            self._in_progress[host, port] = self._loop.create_task(self._call(host, port))

    async def _call(self, host: str, port: int) -> None:
        try:
            async with asyncio.timeout(_CALL_TIMEOUT_S):
                await self._call_back(host, port)
        except OSError as error:
            is_late = isinstance(error, TimeoutError)
            reason = f"no answer within {_CALL_TIMEOUT_S:g} s" if is_late else error.strerror or str(error)
            text = (
                f"{host} asked by UDP to be connected to on TCP port {port}, which does not work ({reason}); "
                "allow this in its firewall, or let the client use the address tcp://HOST:PORT"
            )
            self._events.log(logging.INFO, text, "not called")
        finally:
            del self._in_progress[host, port]
