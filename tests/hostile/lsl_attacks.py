"""What a program on the network can do to the ports of LSL."""

import asyncio
import contextlib
import os
import random
import socket
from typing import Final

from tests.hostile.port_attacks import Attack, endless, short, silent, stalled, together

SEARCH_PORT: Final = 16571
STREAM_PORTS: Final = range(16572, 16582)
"""liblsl takes the first free ports from 16572, one for each stream."""

_REQUEST: Final = (
    b"LSL:streamfeed/110 \r\nNative-Byte-Order: 1234\r\nMax-Buffer-Length: 2000000000\r\n"
    b"Max-Chunk-Length: 0\r\nProtocol-Version: 110\r\n\r\n"
)
_MISTAKES: Final = (
    b"LSL:streamfeed/ \r\n\r\n",
    b"LSL:streamfeed/99999999999999999999 x\r\n\r\n",
    b"LSL:streamfeed/110 \r\nNative-Byte-Order: x\r\nValue-Size: -1\r\nMax-Chunk-Length: -5\r\n\r\n",
    b"LSL:shortinfo\r\n" + b"[" * 10_000 + b"\r\n",
    b"LSL:shortinfo\r\nname='lab_3d' and not(not(position()=1))\r\n",
    b"GET / HTTP/1.1\r\n\r\n",
    b"\r\n" * 1000,
)


def _mistake() -> bytes:
    return random.choice((*_MISTAKES, os.urandom(1000)))


def _on_every_port(attack: Attack) -> Attack:
    async def on_every_port(_port: int) -> None:
        await asyncio.gather(*(together(attack)(port) for port in STREAM_PORTS))

    return on_every_port


async def _datagrams(_port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        while True:
            for port in (SEARCH_PORT, *STREAM_PORTS):
                with contextlib.suppress(OSError):
                    sender.sendto(_mistake(), ("127.0.0.1", port))
            await asyncio.sleep(0.005)


ATTACKS: Final[dict[str, Attack]] = {
    "endless line": _on_every_port(endless(b"", b"x" * 262_144)),  # which liblsl stores
    "silent connections": _on_every_port(silent(200)),
    "stalled receivers": _on_every_port(stalled(50, _REQUEST)),
    "mistakes": together(_on_every_port(short(_mistake)), _datagrams),
}
"""Each goes on until it is cancelled. The ports are always the same."""
