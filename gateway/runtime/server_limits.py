"""What the clients of a TCP server may use up. They are untrusted, so all of it has a limit.

The servers for RTC3D, VRPN, viewers and monitoring have one ``ServerLimits`` each, with what differs from the
defaults, and count their connections with ``Clients``.
"""

import contextlib
import socket
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

from gateway.runtime.token_bucket import TokenBucket


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerLimits:
    """The limits of one server."""

    clients: int
    """How many clients are served; one more is refused. Each costs time for every frame, and memory."""

    handshakes: int | None = None
    """How many connections may not have shown yet that they speak the protocol; one more ends the oldest.

    So a port scan keeps nobody out for long. None means as many as there are free places for clients.
    """

    handshake_s: float = 5.0
    """How long a connection may take to show that. A client in the same building needs milliseconds."""

    unread_bytes: int = 1024 * 1024
    """How much is kept for a client that does not read: some seconds of its frames. Then it loses frames."""

    unread_bytes_in_all: int = 512 * 1024 * 1024
    """How much is kept for all together: with many clients, each one has less than ``unread_bytes``."""

    unread_s: float = 30.0
    """How long a client may leave so much unread until it is disconnected: it hangs, or has vanished."""

    received_bytes_per_s: float = 16 * 1024.0
    received_burst_bytes: float = 256 * 1024.0
    """How much is read from a client on average, and at once when it connects: some kB are usual."""

    read_bytes: int = 4096
    """How much is read at once, so that a client that sends a lot leaves time for others."""

    accepts_per_s: float = 50.0
    accepts_burst: float = 100.0
    """How many connections are accepted, where the server does this itself; others wait in the kernel."""

    close_s: float = 0.5
    """How long a server that closes waits until its clients have read what was sent."""

    @property
    def unread_bytes_each(self) -> int:
        """How much is kept for each client."""
        return min(self.unread_bytes, self.unread_bytes_in_all // self.clients)

    def new_received_budget(self) -> TokenBucket:
        """Return the budget of the bytes that are read from one client."""
        return TokenBucket(self.received_bytes_per_s, self.received_burst_bytes)


_Client = TypeVar("_Client", bound=Hashable)


class Clients(Generic[_Client]):
    """The connections of one server: those in the handshake, and the clients that are served.

    ``disconnect`` ends a connection at once.
    """

    def __init__(self, limits: ServerLimits, disconnect: Callable[[_Client], object]) -> None:
        self.limits = limits
        self.served: dict[_Client, None] = {}
        """Those that have completed the handshake. Any thread may ask whether there are any."""
        self._disconnect = disconnect
        self._in_handshake: dict[_Client, None] = {}  # oldest first

    def __len__(self) -> int:
        return len(self._in_handshake) + len(self.served)

    def __iter__(self) -> Iterator[_Client]:
        return iter((*self._in_handshake, *self.served))

    @property
    def is_full(self) -> bool:
        """Whether a further client must be refused."""
        return len(self.served) >= self.limits.clients

    def open(self, client: _Client) -> None:
        """Add a new connection, and disconnect the oldest one in the handshake if there are too many."""
        most = self.limits.handshakes
        if most is None:
            most = self.limits.clients - len(self.served)
        if len(self._in_handshake) >= most:
            self.disconnect_oldest()
        self._in_handshake[client] = None

    def serve(self, client: _Client) -> None:
        """Note that a connection has completed the handshake."""
        self._in_handshake.pop(client, None)
        self.served[client] = None

    def close(self, client: _Client) -> None:
        """Forget a connection that has ended, if it is known."""
        self._in_handshake.pop(client, None)
        self.served.pop(client, None)

    def disconnect_oldest(self) -> None:
        """Disconnect the oldest connection in the handshake, if there is one."""
        if self._in_handshake:
            oldest = next(iter(self._in_handshake))
            del self._in_handshake[oldest]
            self._disconnect(oldest)


_KEEPALIVE: Final = {"TCP_KEEPIDLE": 10, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 3}  # s, s, probes


def notice_vanished(tcp: socket.socket, limits: ServerLimits) -> None:
    """Let the system end the connection of a client whose computer has vanished without an end.

    While nothing is sent, probes find out after 25 s. While data is unread, it waits for ``unread_s``.
    """
    with contextlib.suppress(OSError):  # the connection has ended already
        tcp.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in (*_KEEPALIVE.items(), ("TCP_USER_TIMEOUT", int(1000 * limits.unread_s))):
            if hasattr(socket, name):  # not every system has all of them
                tcp.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
