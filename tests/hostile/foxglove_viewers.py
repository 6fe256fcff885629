"""Hostile viewers on the port of the output ``foxglove``, in a process of their own.

python -m tests.hostile.foxglove_viewers NAME PORT
"""

import asyncio
import contextlib
import itertools
import json
import os
import sys
from collections.abc import Awaitable, Callable
from typing import Final

from tests.foxglove_viewer import PING, client_frame, upgrade_request

KEY: Final = b"AAAAAAAAAAAAAAAAAAAAAA=="
HANDSHAKE: Final = upgrade_request(KEY, "foxglove.sdk.v1")
NUM_CONNECTIONS: Final = 200
SUBSCRIBE: Final = client_frame(
    json.dumps(
        {"op": "subscribe", "subscriptions": [{"id": number, "channelId": number} for number in range(100)]}
    ).encode()
)

Connection = tuple[asyncio.StreamReader, asyncio.StreamWriter]


async def connected(port: int, handshake: bytes = HANDSHAKE) -> Connection:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(handshake)
    return reader, writer


async def repeated(port: int, handshake: bytes, *messages: bytes) -> None:
    """Send messages as fast as the gateway takes them; connect again whenever it disconnects."""
    while True:
        with contextlib.suppress(OSError):
            reader, writer = await connected(port, handshake)
            reading = asyncio.create_task(reader.read(-1))
            try:
                for message in itertools.cycle(messages):
                    writer.write(message)
                    await writer.drain()
            finally:
                reading.cancel()
                writer.transport.abort()


async def garbage(port: int) -> None:
    """Random bytes, instead of a handshake and after it."""
    await asyncio.gather(
        repeated(port, b"", os.urandom(5000)),
        repeated(port, b"GET / HTTP/1.1\r\n", b"X: " + b"x" * 4000, b"\r\n"),
        repeated(port, HANDSHAKE, os.urandom(5000)),
        repeated(port, upgrade_request(KEY, "chat"), b""),
    )


async def half_open(port: int) -> None:
    """Connections that say nothing, or half of a handshake."""
    while True:
        connections = []
        for number in range(NUM_CONNECTIONS):
            with contextlib.suppress(OSError):
                connections.append(await connected(port, HANDSHAKE[: 60 * (number % 2)]))
        await asyncio.sleep(0.5)
        for _, writer in connections:
            writer.transport.abort()


async def huge(port: int) -> None:
    """A frame of 16 EB, messages of 1 MB, and messages in empty pieces without end."""
    enormous = bytes((0x81, 0xFF)) + b"\x7f" + b"\xff" * 7 + bytes(4)
    await asyncio.gather(
        repeated(port, HANDSHAKE, enormous, bytes(100_000)),
        repeated(port, HANDSHAKE, client_frame(b'"' + b"x" * 1_000_000 + b'"')),
        repeated(port, HANDSHAKE + b"\x01\x80" + bytes(4), (b"\x00\x80" + bytes(4)) * 100),
    )


async def requests(port: int) -> None:
    """What is no request, subscriptions without end, and pings."""
    texts = (b"[" * 10_000, b"{}", b"1" * 5000, b'{"op":"subscribe","subscriptions":[{"id":-1}]}')
    unsubscribe = client_frame(
        json.dumps({"op": "unsubscribe", "subscriptionIds": list(range(100))}).encode()
    )
    await asyncio.gather(
        repeated(port, HANDSHAKE, *map(client_frame, texts)),
        repeated(port, HANDSHAKE, SUBSCRIBE, unsubscribe),
        repeated(port, HANDSHAKE, client_frame(b"ping", PING) * 100),
    )


async def stalled(port: int) -> None:
    """More viewers than are accepted, which subscribe to everything and read nothing."""
    connections = []
    for _ in range(NUM_CONNECTIONS):
        reader, writer = await connected(port)
        reader._transport.pause_reading()  # type: ignore[attr-defined]
        writer.write(SUBSCRIBE)
        connections.append((reader, writer))
    await asyncio.Event().wait()


async def connecting(port: int) -> None:
    """Viewers that connect and disconnect as fast as they can."""

    async def one() -> None:
        while True:
            with contextlib.suppress(OSError):
                _, writer = await connected(port, HANDSHAKE + SUBSCRIBE)
                await writer.drain()
                writer.transport.abort()

    await asyncio.gather(*(one() for _ in range(4)))


ATTACKS: Final[dict[str, Callable[[int], Awaitable[None]]]] = {
    attack.__name__: attack for attack in (garbage, half_open, huge, requests, stalled, connecting)
}


if __name__ == "__main__":
    asyncio.run(ATTACKS[sys.argv[1]](int(sys.argv[2])))  # type: ignore[arg-type]
