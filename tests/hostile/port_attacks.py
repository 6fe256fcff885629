"""Attacks on the ports of outputs that differ only in the bytes that are sent."""

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator, Awaitable, Callable

Attack = Callable[[int], Awaitable[None]]
"""Attacks a port on this computer until it is cancelled. If it ends, or raises OSError, it begins again."""


@contextlib.asynccontextmanager
async def attacking(attack: Attack, port: int) -> AsyncIterator[None]:
    """Attack a port during the block."""
    task = asyncio.create_task(repeating(attack, port))
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def repeating(attack: Attack, port: int) -> None:
    while True:
        with contextlib.suppress(OSError):
            await attack(port)
        await asyncio.sleep(0.01)


def together(*attacks: Attack) -> Attack:
    """Several attacks on one port at the same time, each again and again."""

    async def attack(port: int) -> None:
        await asyncio.gather(*(repeating(each, port) for each in attacks))

    return attack


def stalled(num_clients: int, sent: bytes) -> Attack:
    """Many clients that send something, and read nothing after it."""

    async def attack(port: int) -> None:
        with contextlib.ExitStack() as stack:
            for _ in range(num_clients):
                client = stack.enter_context(socket.create_connection(("127.0.0.1", port), 5))
                client.sendall(sent)
            await asyncio.sleep(5)

    return attack


def silent(num_connections: int) -> Attack:
    """Many connections that never say anything."""

    async def attack(port: int) -> None:
        with contextlib.ExitStack() as stack:
            for _ in range(num_connections):
                client = stack.enter_context(socket.socket())
                client.setblocking(False)
                with contextlib.suppress(OSError):
                    await asyncio.get_running_loop().sock_connect(client, ("127.0.0.1", port))
            await asyncio.Event().wait()

    return attack


def short(sent: Callable[[], bytes]) -> Attack:
    """Connect, send something and disconnect, as fast as possible."""

    async def attack(port: int) -> None:
        while True:
            with contextlib.suppress(OSError):
                _, writer = await asyncio.open_connection("127.0.0.1", port)
                writer.write(sent())
                writer.close()

    return attack


def endless(begin: bytes, repeated: bytes, *, reads: bool = True) -> Attack:
    """Send ``begin``, then ``repeated`` without end."""

    async def attack(port: int) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        reading = asyncio.create_task(_discard(reader) if reads else asyncio.Event().wait())
        try:
            writer.write(begin)
            while not reading.done():
                writer.write(repeated)
                await writer.drain()
        finally:
            reading.cancel()
            writer.close()

    return attack


async def _discard(reader: asyncio.StreamReader) -> None:
    with contextlib.suppress(OSError):
        while await reader.read(65536):
            pass
