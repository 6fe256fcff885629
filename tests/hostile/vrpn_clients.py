"""Hostile VRPN clients. Each attacks the port of a gateway's VRPN server until it is cancelled."""

import asyncio
import contextlib
import os
import socket
from collections.abc import Awaitable, Callable, Iterator
from typing import Final

from tests.hostile.endless_sender import send_endlessly
from tests.networks import free_port
from tests.vrpn_client import COOKIE, PING_TYPE, description, message

NUM_STALLED: Final = 60
NUM_SILENT: Final = 100
_DATAGRAMS_AT_ONCE: Final = 500


@contextlib.contextmanager
def _connections(port: int, count: int) -> Iterator[list[socket.socket]]:
    with contextlib.ExitStack() as stack:
        yield [stack.enter_context(socket.create_connection(("127.0.0.1", port), 5)) for _ in range(count)]


async def _stalled(port: int) -> None:
    """Many clients that read nothing after they have connected."""
    while True:
        with _connections(port, NUM_STALLED) as clients:
            for client in clients:
                client.sendall(COOKIE)
            await asyncio.sleep(5)


async def _silent(port: int) -> None:
    """Connections that never say anything, one after the other."""
    with contextlib.ExitStack() as stack:
        for _ in range(NUM_SILENT):
            client = stack.enter_context(socket.socket())
            client.setblocking(False)
            with contextlib.suppress(OSError):
                await asyncio.get_running_loop().sock_connect(client, ("127.0.0.1", port))
        await asyncio.Event().wait()


def _sending(begin: bytes, repeated: bytes) -> "Attack":
    return lambda port: send_endlessly(port, begin, repeated)


async def _garbage(port: int) -> None:
    """Connect, send anything, and disconnect, as fast as possible."""
    while True:
        with contextlib.suppress(OSError):
            _, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(os.urandom(2000) if os.urandom(1)[0] % 2 else COOKIE + os.urandom(2000))
            writer.close()


async def _knocks(port: int) -> None:
    """Ask by UDP for connections to many ports, open, closed and impossible, and send anything."""
    with contextlib.ExitStack() as stack:
        listeners = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(20)]
        ports = [listener.getsockname()[1] for listener in listeners]
        ports += [free_port() for _ in range(20)]
        requests = [f"127.0.0.1 {each}\0".encode() for each in (*ports, port, 22, 0, 99999)]
        requests += [b"192.0.2.1 5000\0", b"x" * 60_000, os.urandom(1000), b""]
        sender = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        while True:
            for number in range(_DATAGRAMS_AT_ONCE):
                with contextlib.suppress(OSError):
                    sender.sendto(requests[number % len(requests)], ("127.0.0.1", port))
            await asyncio.sleep(0.005)


Attack = Callable[[int], Awaitable[None]]

_NAMES: Final = b"".join(description(number, -1, f"Tool_{number % 9}") for number in range(2000))
_PINGS: Final = b"".join(message(number, PING_TYPE) for number in range(2000))

ATTACKS: Final[dict[str, Attack]] = {
    "stalled clients": _stalled,
    "silent connections": _silent,
    "pings": _sending(COOKIE + description(PING_TYPE, -2, "vrpn_Base ping_message") + _NAMES, _PINGS),
    "descriptions": _sending(COOKIE, _NAMES),
    "large messages": _sending(COOKIE, message(0, 9, bytes(64_000)) * 4),
    "endless cookie": _sending(b"vrpn: ver. 07.", b"7" * 65536),
    "HTTP": _sending(b"", b"GET / HTTP/1.1\r\nHost: x\r\n\r\n" * 1000),
    "garbage": _garbage,
    "requests by UDP": _knocks,
}
