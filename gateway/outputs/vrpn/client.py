"""One client's TCP connection."""

import asyncio
import contextlib
import socket
from typing import Final, Protocol, cast

from gateway.errors import PeerError
from gateway.messages.host_time import now_utime
from gateway.outputs.vrpn.protocol import (
    COOKIE,
    TYPE_DESCRIPTIONS,
    ClientReader,
    encode_pong,
)
from gateway.outputs.vrpn.trackers import Trackers
from gateway.token_bucket import TokenBucket

MAX_UNREAD_BYTES: Final = 256 * 1024
"""How many bytes are kept for a client that does not read; beyond this, it misses poses."""

HANDSHAKE_TIMEOUT_S: Final = 5.0
"""How long a client may take to send its cookie."""

UNREAD_TIMEOUT_S: Final = 30.0
"""How long a client may leave MAX_UNREAD_BYTES unread before it is disconnected."""

_READ_BYTES: Final = 4096
"""How much is read at once, so that a client that sends a lot leaves time for others."""

_READ_BYTES_PER_S: Final = 16 * 1024.0
_READ_BURST_BYTES: Final = 256 * 1024.0
"""How much of one client is read: descriptions of its names and types, and pings until they are answered."""

_READ_PAUSE_S: Final = 0.25

_KEEPALIVE: Final = {
    "TCP_KEEPIDLE": 10,
    "TCP_KEEPINTVL": 5,
    "TCP_KEEPCNT": 4,
    "TCP_USER_TIMEOUT": int(1000 * UNREAD_TIMEOUT_S),
}
"""Options of TCP that end a connection whose other side has disappeared, after about UNREAD_TIMEOUT_S.

Not every system has all of them.
"""


class ClientOwner(Protocol):
    """What a connection needs from its server."""

    trackers: Trackers

    read_budget: TokenBucket
    """How many bytes of all clients together may be read."""

    def client_opened(self, client: "Client") -> bool:
        """Add a new connection. Return False if there are too many: it is closed."""
        ...

    def client_ready(self, client: "Client") -> None:
        """Take note that a client speaks VRPN."""
        ...

    def client_failed(self, client: "Client", text: str) -> None:
        """Take note that a client is disconnected because of what ``text`` says."""
        ...

    def client_closed(self, client: "Client") -> None:
        """Remove a connection that has ended."""
        ...


class Client(asyncio.BufferedProtocol):
    """Exchanges cookies with one client, describes the trackers to it, and sends it their poses.

    While a client does not read, it gets no poses. Trackers are described before their first pose, and
    whenever they change.
    """

    name = "a client"
    """The client's address and port."""

    def __init__(self, owner: ClientOwner) -> None:
        self.is_ready = False
        """Whether the client has sent its cookie."""
        self._owner = owner
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport
        self._received = bytearray(_READ_BYTES)
        self._reader = ClientReader()
        self._budget = TokenBucket(_READ_BYTES_PER_S, _READ_BURST_BYTES)
        self._is_full = False  # whether MAX_UNREAD_BYTES wait for the client to read
        self._timeout: asyncio.TimerHandle | None = None
        self._described: dict[int, str] = {}  # the names of the trackers by number, as the client knows them
        self._version = -1  # of the trackers that were described last

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Send the cookie: both sides do so without waiting for the other (asyncio.BaseProtocol)."""
        self._transport = cast(asyncio.Transport, transport)
        address = transport.get_extra_info("peername")
        if address:  # None if the connection has ended already
            self.name = f"{address[0]}:{address[1]}"
        if not self._owner.client_opened(self):
            self._transport.abort()
            return
        connection = cast(socket.socket, transport.get_extra_info("socket"))
        with contextlib.suppress(OSError):  # the connection has ended already
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for name, value in _KEEPALIVE.items():
                if hasattr(socket, name):
                    connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        self._transport.set_write_buffer_limits(high=MAX_UNREAD_BYTES)
        self._transport.write(COOKIE)
        self._set_timeout(
            HANDSHAKE_TIMEOUT_S,
            f"it sent no VRPN cookie within {HANDSHAKE_TIMEOUT_S:g} s: is it a VRPN client?",
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
        """Answer pings (asyncio.BufferedProtocol)."""
        if self._transport.is_closing():
            return
        try:
            pinged = self._reader.receive(bytes(self._received[:nbytes]))
        except PeerError as error:
            self._fail(str(error))
            return
        if self._reader.has_cookie and not self.is_ready:
            self._become_ready()
        self._answer(pinged)
        self._budget.take(nbytes)
        self._owner.read_budget.take(nbytes)
        if not self._may_read():
            self._transport.pause_reading()
            self._loop.call_later(_READ_PAUSE_S, self._resume_reading)

    def _become_ready(self) -> None:
        self.is_ready = True
        self._clear_timeout()
        self._transport.write(TYPE_DESCRIPTIONS)
        self.describe_trackers()
        self._owner.client_ready(self)

    def _answer(self, pinged: list[str]) -> None:
        """Answer pings of trackers that there are. A client repeats a ping until it is answered."""
        trackers = filter(None, map(self._owner.trackers.named, pinged))
        pongs = b"".join(encode_pong(tracker.number, now_utime()) for tracker in trackers)
        if pongs and not self._is_full:
            self.describe_trackers()
            self._transport.write(pongs)

    def _may_read(self) -> bool:
        return self._budget.left > 0 and self._owner.read_budget.left > 0

    def _resume_reading(self) -> None:
        if self._transport.is_closing():
            return
        if self._may_read():
            self._transport.resume_reading()
        else:
            self._loop.call_later(_READ_PAUSE_S, self._resume_reading)

    # Writing --------------------------------------------------------------------------------

    def describe_trackers(self) -> None:
        """Describe those trackers to the client that it does not know yet, unless it does not read."""
        trackers = self._owner.trackers
        if self._is_full or self._transport.is_closing() or self._version == trackers.version:
            return
        self._version = trackers.version
        new = [tracker for tracker in trackers.current if self._described.get(tracker.number) != tracker.name]
        self._described.update((tracker.number, tracker.name) for tracker in new)
        self._transport.write(b"".join(tracker.description for tracker in new))

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
        self._set_timeout(UNREAD_TIMEOUT_S, f"it has read nothing for {UNREAD_TIMEOUT_S:g} s")

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
        self._owner.client_failed(self, text)
        self._transport.abort()
