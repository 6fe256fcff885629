"""Hostile VRPN clients. Each attacks the port of a gateway's VRPN server until it is cancelled."""

import asyncio
import contextlib
import os
import socket
from typing import Final

from tests.hostile.port_attacks import Attack, endless, short, silent, stalled
from tests.networks import free_port
from tests.vrpn_client import COOKIE, PING_TYPE, description, message

NUM_STALLED: Final = 60
NUM_SILENT: Final = 100
_DATAGRAMS_AT_ONCE: Final = 500

_NAMES: Final = b"".join(description(number, -1, f"Tool_{number % 9}") for number in range(2000))
_PINGS: Final = b"".join(message(number, PING_TYPE) for number in range(2000))


def _garbage() -> bytes:
    return os.urandom(2000) if os.urandom(1)[0] % 2 else COOKIE + os.urandom(2000)


async def _callback_requests(port: int) -> None:
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


ATTACKS: Final[dict[str, Attack]] = {
    "stalled clients": stalled(NUM_STALLED, COOKIE),
    "silent connections": silent(NUM_SILENT),
    "pings": endless(COOKIE + description(PING_TYPE, -2, "vrpn_Base ping_message") + _NAMES, _PINGS),
    "descriptions": endless(COOKIE, _NAMES),
    "large messages": endless(COOKIE, message(0, 9, bytes(64_000)) * 4),
    "endless cookie": endless(b"vrpn: ver. 07.", b"7" * 65536),
    "HTTP": endless(b"", b"GET / HTTP/1.1\r\nHost: x\r\n\r\n" * 1000),
    "garbage": short(_garbage),
    "requests by UDP": _callback_requests,
}
