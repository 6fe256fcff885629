"""What a program on the network can do to the ports of LSL."""

import asyncio
import contextlib
import os
import socket
from typing import Final

from tests.hostile.port_attacks import Attack

SEARCH_PORT: Final = 16571
STREAM_PORTS: Final = range(16572, 16582)
"""liblsl takes the first free ports from 16572, one for each stream."""

_PIECE: Final = b"x" * 262_144
_NUM_SILENT: Final = 2000
_NUM_RECEIVERS: Final = 50
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


async def endless_line(_port: int) -> None:
    """Send bytes without the end of a line, which liblsl stores."""

    async def send(port: int) -> None:
        while True:
            with contextlib.suppress(OSError):
                _, writer = await asyncio.open_connection("127.0.0.1", port)
                with contextlib.closing(writer):
                    while True:
                        writer.write(_PIECE)
                        await writer.drain()
            await asyncio.sleep(0.01)

    async with asyncio.TaskGroup() as group:
        for port in STREAM_PORTS:
            group.create_task(send(port))


async def silent_connections(_port: int) -> None:
    """Open connections that say nothing, and keep them."""
    with contextlib.ExitStack() as kept:
        for at in range(_NUM_SILENT):
            connection = kept.enter_context(socket.socket())
            connection.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                connection.connect(("127.0.0.1", STREAM_PORTS[at % len(STREAM_PORTS)]))
            await asyncio.sleep(0.0005)
        await asyncio.Event().wait()


async def stalled_receivers(_port: int) -> None:
    """Ask for all samples, and never read them."""
    with contextlib.ExitStack() as kept:
        for _ in range(_NUM_RECEIVERS):
            for port in STREAM_PORTS:
                connection = socket.socket()
                try:
                    connection.connect(("127.0.0.1", port))
                    connection.sendall(_REQUEST)
                except OSError:  # liblsl uses fewer ports
                    connection.close()
                else:
                    kept.enter_context(connection)
                await asyncio.sleep(0)
        await asyncio.Event().wait()


async def mistakes(_port: int) -> None:
    """Send requests that are wrong in several ways, half of them half-open, and datagrams of nonsense."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        while True:
            for request in (*_MISTAKES, os.urandom(1000)):
                for port in STREAM_PORTS:
                    with contextlib.suppress(OSError):
                        _, writer = await asyncio.open_connection("127.0.0.1", port)
                        with contextlib.closing(writer):
                            writer.write(request)
                            await writer.drain()
                            writer.write_eof()
                    for target in (port, SEARCH_PORT):
                        with contextlib.suppress(OSError):
                            sender.sendto(request, ("127.0.0.1", target))
                await asyncio.sleep(0.005)


ATTACKS: Final[dict[str, Attack]] = {
    "endless line": endless_line,
    "silent connections": silent_connections,
    "stalled receivers": stalled_receivers,
    "mistakes": mistakes,
}
"""Each goes on until it is cancelled. The ports are always the same."""
