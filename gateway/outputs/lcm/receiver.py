"""Receiving requests on LCM in a thread, on channels that are added while it runs.

The library trusts what it receives (lcm 1.5.3, lcm_udpm.c): a datagram without the NUL behind its channel,
or a fragment whose place is behind the end of its message, makes it use memory that is not its own, and ends
the process. Anyone whose datagrams reach this computer can send them. So datagrams on udpm:// are received
without it. docs/reference/messages.md describes LCM's packets.
"""

import contextlib
import ipaddress
import logging
import socket
import struct
import threading
from collections.abc import Callable
from typing import Final, TypeVar

import lcm

from gateway.errors import OutputError
from gateway.outputs.lcm.connection import (
    Waiting,
    multicast_destination,
    multicast_problem,
    open_lcm,
    reconnect,
    scheme_of,
    send_problem,
)
from gateway.outputs.lcm.sender import RETRY_S
from gateway.runtime.failures import FailureLog
from gateway.runtime.token_bucket import TokenBucket
from gateway.runtime.workers import WorkerThread, thread_starts

_MAGIC: Final = b"LC02"
"""Begins a datagram with a whole message. Those with fragments of one are ignored."""

_HEADER_BYTES: Final = 8
_MAX_DATAGRAM_BYTES: Final = 65_535

MAX_PENDING: Final = 64
"""The maximum number of requests in progress. Further ones are dropped and counted."""

MAX_REQUEST_BYTES: Final = 4096
"""Longer messages are no requests: anybody can send them, and to decode them takes time."""

RECEIVED_PER_S: Final = 2000.0
"""How many messages a second are received. LCM or the kernel discards further ones, uncounted."""

_OTHER_CHANNEL: Final = 0.05
"""How much of RECEIVED_PER_S any other datagram uses. On udpm://, what the gateway publishes arrives, too."""

_PAUSE_S: Final = 0.02
_ERROR_PAUSE_S: Final = 0.1
_JOIN_S: Final = 0.3

Take = Callable[[bytes], None]
"""Takes a message, in the receiving thread."""

_Result = TypeVar("_Result")

logger = logging.getLogger(__name__)


def split_datagram(datagram: bytes) -> tuple[str, bytes]:
    """Return the channel and the message in a datagram; both are empty if it has no whole message."""
    channel, nul, message = datagram[_HEADER_BYTES:].partition(b"\0")
    is_whole = datagram.startswith(_MAGIC) and nul
    return (channel.decode("utf-8", "replace"), message) if is_whole else ("", b"")


def joined_socket(url: str) -> socket.socket:
    """Return a socket that receives what is sent to a URL udpm://.

    Raises OutputError if the group cannot be joined.
    """
    destination = multicast_destination(url)
    problem = multicast_problem(url) if destination else f"{url} has no multicast address; check lcm.url"
    if destination is None or problem:
        raise OutputError(problem, cause="not open")
    joined = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        joined.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        joined.setblocking(False)  # or a datagram that was damaged on its way would keep the thread waiting
        joined.bind(destination)
        membership = struct.pack("=4s4s", ipaddress.IPv4Address(destination[0]).packed, bytes(4))
        joined.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
    except OSError as error:
        joined.close()
        raise OutputError(f"LCM does not open {url}: {error}; check lcm.url", cause="not open") from error
    return joined


class LcmReceiver:
    """Receives requests on ``url``. ``prefix`` begins the name of a channel that nobody subscribes to.

    If there is a ``shared`` LCM object (memq://), the owner of that object receives instead. Requests wait in
    a queue of LCM's library for each channel, those on udpm:// in the kernel. ``on_open`` is called in the
    thread once LCM has opened.
    """

    def __init__(self, url: str, prefix: str, shared: lcm.LCM | None, on_open: Callable[[], None]) -> None:
        self._url = url
        self._prefix = prefix
        self._shared = shared
        self._on_open = on_open
        self._channels: dict[str, Take] = {}
        self._subscriptions: dict[str, lcm.LCMSubscription] = {}  # by channel
        self._thread = threading.Thread(target=self._run, name="lcm-requests", daemon=True)
        self._closing = threading.Event()
        self._waiting: Waiting | None = None  # of the thread
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
        self._wake()

    def _wake(self) -> None:
        """Let the thread see that something has changed."""
        if self._waiting is not None:
            self._waiting.wake()

    async def close(self) -> None:
        """Stop receiving."""
        self._closing.set()
        self._wake()
        if self._thread.is_alive():
            await WorkerThread("join lcm-requests").run(lambda: self._thread.join(_JOIN_S))
        if self._shared is not None:
            for subscription in self._subscriptions.values():
                self._shared.unsubscribe(subscription)

    # In the receiving thread.

    def _run(self) -> None:
        opened: Callable[[str], lcm.LCM | socket.socket]
        opened = joined_socket if scheme_of(self._url) == "udpm" else open_lcm
        waiting = self._retry(Waiting)
        if waiting is None:
            return
        with contextlib.closing(waiting) as self._waiting:
            connection = self._retry(lambda: opened(self._url))
            if connection is not None:
                self._on_open()
                self._receive(connection, waiting)
        if isinstance(connection, socket.socket):
            connection.close()

    def _retry(self, attempt: Callable[[], _Result]) -> _Result | None:
        """Return what ``attempt`` returns once it does not raise; None if ``close`` is called first."""
        while not self._closing.is_set():
            try:
                result = attempt()
            except (OutputError, OSError) as error:
                problem = send_problem(self._url, error) if isinstance(error, OSError) else error
                self._opening.failed(f"no requests can be received: {problem} (this is lcm.queries_url)")
                self._closing.wait(RETRY_S)
            else:
                self._opening.recovered("requests can be received")
                return result
        return None

    def _receive(self, connection: lcm.LCM | socket.socket, waiting: Waiting) -> None:
        """Receive requests until ``close``."""
        while not self._closing.is_set():
            if isinstance(connection, lcm.LCM):
                self._subscribe(connection)
            if self._received.left <= 0:
                self._closing.wait(_PAUSE_S)  # or a flood would keep other threads from running
            try:
                if not waiting.wait(connection):
                    continue
                if isinstance(connection, lcm.LCM):
                    connection.handle_timeout(0)
                else:
                    self._handle(*split_datagram(connection.recv(_MAX_DATAGRAM_BYTES)))
            except BlockingIOError:
                pass  # the kernel has discarded a damaged datagram
            except OSError as error:
                logger.debug("receiving LCM requests: %s", error)
                self._closing.wait(_ERROR_PAUSE_S)
                if isinstance(connection, lcm.LCM) and scheme_of(self._url) == "tcpq":
                    self._retry(lambda: reconnect(connection, f"{self._prefix}_RECONNECTED"))

    def _subscribe(self, connection: lcm.LCM) -> None:
        """Subscribe to the channels that are new."""
        channels = self._channels.copy()
        for channel in channels.keys() - self._subscriptions.keys():
            subscription = connection.subscribe(f"^{channel}$", self._handle)
            subscription.set_queue_capacity(MAX_PENDING)
            self._subscriptions[channel] = subscription

    def _handle(self, channel: str, data: bytes) -> None:
        take = self._channels.get(channel)
        self._received.take(1 if take else _OTHER_CHANNEL)
        if take:
            take(data)
