"""The VRPN server: accepts clients over TCP, calls back those that ask by UDP, and sends poses to all.

That is how libvrpn connects unless the address begins with tcp:. Anybody can send such a datagram, with any
sender's address. So the server connects only to the address that the datagram came from, never to ports of
system services, and only to a few addresses at a time; datagrams beyond a rate are not read. A client repeats
its request every 2 s.

Everything here runs in the event loop of the output's own thread, unless it says otherwise. Clients are
untrusted: their number, how fast they connect, and how much is read from them and kept for them is bounded.
"""

import asyncio
import contextlib
import logging
import socket
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, Final

from gateway.logs.failures import DefectLog, EventLog, FailureLog, defect_text
from gateway.outputs.vrpn.client import Client
from gateway.outputs.vrpn.protocol import callback_port
from gateway.outputs.vrpn.trackers import TrackerNames, Trackers
from gateway.token_bucket import TokenBucket

_BACKLOG: Final = 64
"""How many clients wait in the kernel to be accepted."""


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


MAX_CALLS: Final = 16
"""To how many clients the server tries to connect at the same time."""

MAX_CALLS_PER_HOST: Final = 4

_CALL_TIMEOUT_S: Final = 2.0
_CALLS_PER_S: Final = 20.0
_DATAGRAMS_PER_S: Final = 200.0
_DATAGRAMS_BURST: Final = 50.0
_PAUSE_S: Final = 0.1
_MAX_DATAGRAM_BYTES: Final = 512

CallBack = Callable[[str, int], Awaitable[None]]
"""Connects to a client's address and TCP port. Raises OSError."""


class CallbackRequests:
    """Reads requests from a UDP socket and calls back those who sent them.

    ``own_port`` is the server's own port, to which it must not connect. ``call_failed`` is called with an
    address, a port and the reason.
    """

    def __init__(
        self,
        udp: socket.socket,
        call_back: CallBack,
        call_failed: Callable[[str, int, str], None],
        own_port: int,
    ) -> None:
        self._udp = udp
        self._call_back = call_back
        self._call_failed = call_failed
        self._own_port = own_port
        self._loop = asyncio.get_running_loop()
        self._datagrams = TokenBucket(_DATAGRAMS_PER_S, _DATAGRAMS_BURST)
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
        """Read what has arrived, or pause: the kernel then drops what its buffer cannot hold."""
        while self._datagrams.try_take():
            try:
                datagram, address = self._udp.recvfrom(_MAX_DATAGRAM_BYTES)
            except OSError:  # there is none, or the network reports an error about an earlier one
                return
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
        except TimeoutError:
            self._call_failed(host, port, f"no answer within {_CALL_TIMEOUT_S:g} s")
        except OSError as error:
            self._call_failed(host, port, error.strerror or str(error))
        finally:
            del self._in_progress[host, port]


MAX_CLIENTS: Final = 64

MAX_HANDSHAKES: Final = 16
"""How many clients may be connected without having sent a cookie. One more disconnects the oldest."""

_ACCEPTS_PER_S: Final = 50.0
_ACCEPTS_BURST: Final = 100.0
_READ_BYTES_PER_S: Final = 128 * 1024.0
_READ_BURST_BYTES: Final = 1024 * 1024.0
_RETRY_S: Final = 1.0
_ACCEPT_PAUSE_S: Final = 0.1
_CLOSE_S: Final = 1.0

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
        """See ClientOwner."""
        self.problem = (
            f"it does not listen on {host}, port {port} yet; if this lasts, check vrpn.host and the name "
            "server (DNS)"
        )
        """Why clients cannot connect, and what to do; "" if they can."""
        self._on_wanted_changed = on_wanted_changed
        self._host = host
        self._port = port
        self._clients: dict[Client, None] = {}  # the oldest first
        self._ready: tuple[Client, ...] = ()
        self._serving: asyncio.Task[None] | None = None
        self._accepts = TokenBucket(_ACCEPTS_PER_S, _ACCEPTS_BURST)
        self._failures = FailureLog(logger, "vrpn")
        self._events = EventLog(logger, "vrpn")
        self._defects = DefectLog(logger, "vrpn")

    @property
    def has_clients(self) -> bool:
        """Whether a client is connected that has shown that it speaks VRPN. Any thread may ask."""
        return bool(self._ready)

    def send(self, poses: bytes) -> list[str]:
        """Send messages with poses to all clients. Return the names of those that miss them."""
        return [client.name for client in self._ready if not client.send(poses)]

    def describe_trackers(self) -> None:
        """Describe trackers that are new to all clients."""
        for client in self._ready:
            client.describe_trackers()

    # Listening ------------------------------------------------------------------------------

    async def serve(self) -> None:
        """Accept clients until ``close``. If the port cannot be used, try again every second."""
        self._serving = asyncio.current_task()
        while True:
            try:
                with contextlib.ExitStack() as sockets:
                    await self._listen(sockets)
            except OSError as error:
                self.problem = (
                    f"{error.strerror or error}; stop the program that uses the port, or set vrpn.host and "
                    "vrpn.port to an address of this computer and a free port"
                )
                self._failures.failed(self.problem)
            except Exception as defect:  # noqa: BLE001 - try again
                self.problem = f"{defect_text(defect)}; report this with the log"
                self._defects.log(defect)
            await asyncio.sleep(_RETRY_S)

    async def _listen(self, sockets: contextlib.ExitStack) -> None:
        """Accept clients. Raises OSError if a socket cannot be bound."""
        tcp = sockets.enter_context(await self._bind(socket.SOCK_STREAM))
        udp = sockets.enter_context(await self._bind(socket.SOCK_DGRAM))
        requests = CallbackRequests(udp, self._call_back, self._call_failed, self._port)
        sockets.callback(requests.close)
        self.problem = ""
        self._failures.succeeded(f"trackers are served on {self._host}, port {self._port}")
        while True:
            await self._accept(tcp)

    async def _bind(self, kind: socket.SocketKind) -> socket.socket:
        """Return a socket that is bound. Raises OSError, whose text says which port it is."""
        protocol = "TCP" if kind is socket.SOCK_STREAM else "UDP"
        try:
            loop = asyncio.get_running_loop()
            return bind(await loop.getaddrinfo(self._host, self._port, type=kind), kind)
        except OSError as error:
            reason = error.strerror or error
            raise OSError(f"cannot listen on {self._host}, {protocol} port {self._port}: {reason}") from error

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
            self._events.log(logging.WARNING, text, "not accepted")
            await asyncio.sleep(_ACCEPT_PAUSE_S)

    async def _call_back(self, host: str, port: int) -> None:
        client = Client(self)
        try:
            await asyncio.get_running_loop().create_connection(lambda: client, host, port)
        except asyncio.CancelledError:
            # uvloop does not call connection_lost if this comes just after connection_made.
            self.client_closed(client)
            raise

    def _call_failed(self, host: str, port: int, reason: str) -> None:
        text = (
            f"{host} asked by UDP to be connected to on TCP port {port}, which does not work ({reason}); "
            "allow this in its firewall, or let the client use the address tcp://HOST:PORT"
        )
        self._events.log(logging.INFO, text, "not called")

    # For clients ----------------------------------------------------------------------------

    def client_opened(self, client: Client) -> bool:
        """See ClientOwner."""
        if len(self._ready) >= MAX_CLIENTS:
            self._refuse(client)
            return False
        waiting = [other for other in self._clients if not other.is_ready]
        if len(waiting) >= MAX_HANDSHAKES:
            waiting[0].abort()
        self._clients[client] = None
        return True

    def client_ready(self, client: Client) -> None:
        """See ClientOwner."""
        if len(self._ready) >= MAX_CLIENTS:
            self._refuse(client)
            client.abort()
            return
        self._set_ready((*self._ready, client))
        text = f"{client.name} is connected; clients now: {len(self._ready)}"
        self._events.log(logging.INFO, text, "connected")

    def _refuse(self, client: Client) -> None:
        text = f"{client.name} is refused: {MAX_CLIENTS} clients are connected"
        self._events.log(logging.WARNING, text, "refused")

    def client_failed(self, client: Client, text: str) -> None:
        """See ClientOwner."""
        self._events.log(logging.INFO, f"{client.name} is disconnected: {text}", "failed")

    def client_closed(self, client: Client) -> None:
        """See ClientOwner."""
        self._clients.pop(client, None)
        if client in self._ready:
            self._set_ready(tuple(other for other in self._ready if other is not client))
            text = f"{client.name} has disconnected; clients now: {len(self._ready)}"
            self._events.log(logging.INFO, text, "closed")

    def _set_ready(self, clients: tuple[Client, ...]) -> None:
        had_clients, self._ready = self.has_clients, clients
        if self.has_clients is not had_clients:
            self._on_wanted_changed()

    async def close(self) -> None:
        """Stop listening and disconnect all clients."""
        self.problem = "the VRPN server is closed; start the gateway again"
        if self._serving is not None:
            self._serving.cancel()
            await asyncio.wait([self._serving])
        for client in list(self._clients):
            client.abort()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_CLOSE_S):
                while self._clients:  # noqa: ASYNC110 - until the loop has closed their sockets
                    await asyncio.sleep(0)
