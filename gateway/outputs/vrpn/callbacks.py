"""Requests by UDP: VRPN clients that want the server to connect to them.

That is how libvrpn connects unless the address begins with tcp:. Anybody can send such a datagram, with any
sender's address. So the server connects only to the address that the datagram came from, never to ports of
system services, and only to a few addresses at a time; datagrams beyond a rate are not read. A client repeats
its request every 2 s.
"""

import asyncio
import socket
from collections.abc import Awaitable, Callable
from typing import Final

from gateway.outputs.vrpn.protocol import callback_port
from gateway.token_bucket import TokenBucket

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
        except TimeoutError:
            self._call_failed(host, port, f"no answer within {_CALL_TIMEOUT_S:g} s")
        except OSError as error:
            self._call_failed(host, port, error.strerror or str(error))
        finally:
            del self._in_progress[host, port]
