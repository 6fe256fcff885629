"""Receiving on LCM in a thread, on channels that are added while it runs.

The library trusts what it receives (lcm 1.5.3, lcm_udpm.c): a datagram without the NUL behind its channel,
or a fragment whose place is behind the end of its message, makes it use memory that is not its own, and ends
the process. Anyone whose datagrams reach this computer can send them. docs/reference/messages.md describes
LCM's packets.
"""

import ipaddress
import logging
import socket
import struct
import threading
from collections.abc import Callable
from typing import Final

import lcm

from gateway.errors import OutputError
from gateway.logs.failures import FailureLog
from gateway.outputs.lcm.connection import (
    multicast_destination,
    multicast_problem,
    open_lcm,
    reconnect,
    scheme_of,
    send_problem,
)
from gateway.outputs.lcm.sender import RETRY_S
from gateway.token_bucket import TokenBucket
from gateway.workers import WorkerThread, thread_starts

_MAGIC: Final = b"LC02"
"""Begins a datagram with a whole message. Those with fragments of one are ignored."""

NO_CHANNEL: Final = ""

_HEADER_BYTES: Final = 8
_MAX_DATAGRAM_BYTES: Final = 65_535


def split_datagram(datagram: bytes) -> tuple[str, bytes] | None:
    """Return the channel and the message in a datagram; None if it has no whole message."""
    if not datagram.startswith(_MAGIC):
        return None
    channel, nul, message = datagram[_HEADER_BYTES:].partition(b"\0")
    return (channel.decode("utf-8", "replace"), message) if nul else None


class LcmDatagrams:
    """Receives on a URL udpm://, and passes the channel and the bytes of each message to ``receive``.

    A datagram that has no whole message counts as an empty message on NO_CHANNEL, because it takes as much
    time. Raises OutputError if the group cannot be joined.
    """

    def __init__(self, url: str, receive: Callable[[str, bytes], None]) -> None:
        self._receive = receive
        destination = multicast_destination(url)
        problem = multicast_problem(url) if destination else f"{url} has no multicast address; check lcm.url"
        if destination is None or problem:
            raise OutputError(problem, cause="not open")
        try:
            self._socket = _joined_socket(*destination)
        except OSError as error:
            raise OutputError(f"LCM does not open {url}: {error}; check lcm.url", cause="not open") from error

    def handle_timeout(self, timeout_ms: int) -> None:
        """Wait for one datagram, as ``lcm.LCM.handle_timeout`` for a message. Raises OSError."""
        self._socket.settimeout(timeout_ms / 1000)
        try:
            datagram = self._socket.recv(_MAX_DATAGRAM_BYTES)
        except TimeoutError:
            return
        self._receive(*(split_datagram(datagram) or (NO_CHANNEL, b"")))

    def close(self) -> None:
        """Leave the group."""
        self._socket.close()


def _joined_socket(group: str, port: int) -> socket.socket:
    """Return a socket that receives what is sent to a multicast group. Raises OSError."""
    joined = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        joined.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        joined.bind((group, port))
        membership = struct.pack("=4s4s", ipaddress.IPv4Address(group).packed, bytes(4))
        joined.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
    except OSError:
        joined.close()
        raise
    return joined


RECEIVED_PER_S: Final = 2000.0
"""How many messages a second are received. LCM or the kernel discards further ones, uncounted."""

_OTHER_CHANNEL: Final = 0.05
"""How much of RECEIVED_PER_S any other datagram uses. On udpm://, what the gateway publishes arrives, too."""

_POLL_MS: Final = 100
_PAUSE_S: Final = 0.02
_JOIN_S: Final = 0.3

Take = Callable[[bytes], None]
"""Takes a message, in the receiving thread."""

logger = logging.getLogger(__name__)


class LcmReceiver:
    """Receives requests on ``url``. ``prefix`` begins the name of a channel that nobody subscribes to.

    If there is a ``shared`` LCM object (memq://), the owner of that object receives instead. Each
    subscription of LCM's library has a queue of ``queue_messages``; requests on udpm:// wait in the kernel.
    ``on_open`` is called in the thread once LCM has opened.
    """

    def __init__(
        self,
        url: str,
        prefix: str,
        shared: lcm.LCM | None,
        queue_messages: int,
        on_open: Callable[[], None],
    ) -> None:
        self._url = url
        self._prefix = prefix
        self._shared = shared
        self._queue_messages = queue_messages
        self._on_open = on_open
        self._channels: dict[str, Take] = {}
        self._subscriptions: dict[str, lcm.LCMSubscription] = {}  # by channel
        self._thread = threading.Thread(target=self._run, name="lcm-requests", daemon=True)
        self._closing = threading.Event()
        self._opening = FailureLog(logger, "lcm")
        self._received = TokenBucket(RECEIVED_PER_S)  # used in the receiving thread

    def start(self) -> None:
        """Receive. Called in any thread, after the output has opened."""
        if self._shared is not None:
            self._subscribe(self._shared)
        else:
            thread_starts.start(self._thread)

    def add(self, channel: str, take: Take) -> None:
        """Receive on one more channel, until ``close``.

        LCM's Python module would free a subscription while the receiving thread may be using it.
        """
        self._channels.setdefault(channel, take)
        if self._shared is not None:
            self._subscribe(self._shared)

    async def close(self) -> None:
        """Stop receiving."""
        self._closing.set()
        if self._thread.is_alive():
            await WorkerThread("join lcm-requests").run(lambda: self._thread.join(_JOIN_S))
        if self._shared is not None:
            for subscription in self._subscriptions.values():
                self._shared.unsubscribe(subscription)

    # In the receiving thread.

    def _run(self) -> None:
        connection = self._open()
        if connection is not None:
            self._on_open()
        while connection is not None and not self._closing.is_set():
            if isinstance(connection, lcm.LCM):
                self._subscribe(connection)
            if self._received.left <= 0:
                self._closing.wait(_PAUSE_S)  # or a flood would keep other threads from running
            try:
                connection.handle_timeout(_POLL_MS)
            except OSError as error:
                logger.debug("receiving LCM requests: %s", error)
                self._closing.wait(_POLL_MS / 1000)
                if isinstance(connection, lcm.LCM) and scheme_of(self._url) == "tcpq":
                    self._reconnect(connection)
        if isinstance(connection, LcmDatagrams):
            connection.close()

    def _open(self) -> lcm.LCM | LcmDatagrams | None:
        """Return what receives requests, with retries; None if ``close`` is called first."""
        while not self._closing.is_set():
            try:
                connection = self._try_to_open()
            except OutputError as error:
                self._opening.failed(f"no requests can be received: {error} (this is lcm.queries_url)")
                self._closing.wait(RETRY_S)
                continue
            self._opening.recovered("requests can be received")
            return connection
        return None

    def _try_to_open(self) -> lcm.LCM | LcmDatagrams:
        if scheme_of(self._url) == "udpm":
            return LcmDatagrams(self._url, self._handle)
        connection = open_lcm(self._url)
        self._subscribe(connection)
        return connection

    def _reconnect(self, connection: lcm.LCM) -> None:
        """Connect to the relay again, with retries, until ``close``."""
        while not self._closing.is_set():
            try:
                reconnect(connection, f"{self._prefix}_RECONNECTED")
            except OSError as error:
                problem = send_problem(self._url, error)
                self._opening.failed(f"no requests can be received: {problem} (this is lcm.queries_url)")
                self._closing.wait(RETRY_S)
            else:
                self._opening.recovered("requests can be received")
                return

    def _subscribe(self, connection: lcm.LCM) -> None:
        """Subscribe to the channels that are new."""
        channels = self._channels.copy()
        for channel in channels.keys() - self._subscriptions.keys():
            subscription = connection.subscribe(f"^{channel}$", self._handle)
            subscription.set_queue_capacity(self._queue_messages)
            self._subscriptions[channel] = subscription

    def _handle(self, channel: str, data: bytes) -> None:
        take = self._channels.get(channel)
        self._received.take(1 if take else _OTHER_CHANNEL)
        if take:
            take(data)
