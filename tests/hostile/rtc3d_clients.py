"""Hostile RTC3D clients. Each attacks the port of a gateway's RT server until it is cancelled."""

import asyncio
import contextlib
import itertools
import os
import socket
import struct
from collections.abc import Awaitable, Callable, Iterator
from typing import Final

from tests.hostile.endless_sender import send_endlessly
from tests.unit.rtc3d_server.wire import DATA, EVENT, command, packet

NUM_STALLED: Final = 60
NUM_SILENT: Final = 150

_START: Final = struct.pack(">IIIiqI", 1, 48, EVENT, -1, 0, 1) + struct.pack(">iqiii", 1, 0, -1, -1, -1)
_WORDS: Final = ("3D", "6D", "Analog", "Force", "Events")
_CHOICES: Final = [
    " ".join(words) for count in range(1, 6) for words in itertools.combinations(_WORDS, count)
]


@contextlib.contextmanager
def _connections(port: int, count: int) -> Iterator[list[socket.socket]]:
    with contextlib.ExitStack() as stack:
        yield [stack.enter_context(socket.create_connection(("127.0.0.1", port), 5)) for _ in range(count)]


async def _stalled(port: int) -> None:
    """Many clients that ask for all frames, and read nothing."""
    while True:
        with _connections(port, NUM_STALLED) as clients:
            for client in clients:
                client.sendall(command("StreamFrames"))
            await asyncio.sleep(5)


async def _silent(port: int) -> None:
    """More connections than are accepted, which never say anything."""
    with contextlib.ExitStack() as stack:
        for _ in range(NUM_SILENT):
            client = stack.enter_context(socket.socket())
            client.setblocking(False)
            with contextlib.suppress(OSError):
                await asyncio.get_running_loop().sock_connect(client, ("127.0.0.1", port))
        await asyncio.Event().wait()


async def _short(port: int) -> None:
    """Connect, ask for frames or send anything, and disconnect, as fast as possible."""
    while True:
        with contextlib.suppress(OSError):
            _, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(command("StreamFrames") if os.urandom(1)[0] % 2 else os.urandom(2000))
            writer.close()


def _sending(sent: bytes, *, reads: bool = True) -> "Attack":
    return lambda port: send_endlessly(port, b"", sent, reads=reads)


Attack = Callable[[int], Awaitable[None]]

_FRAME_REQUESTS: Final = b"".join(
    command(f"{verb} {choice}") for choice in _CHOICES for verb in ("StreamFrames", "SendCurrentFrame")
)

ATTACKS: Final[dict[str, Attack]] = {
    "stalled clients": _stalled,
    "silent connections": _silent,
    "short connections": _short,
    "commands": _sending(command("Version 1.0") * 1000),
    "commands without reading": _sending(command("SendParameters") * 1000, reads=False),
    "requests for all choices": _sending(_FRAME_REQUESTS),
    "parameters of all choices": _sending(
        b"".join(command(f"SendParameters {choice}") for choice in _CHOICES)
    ),
    "recordings": _sending(packet(DATA, _START) + command("Recording Start,file=../x") * 10),
    "empty packets": _sending(packet(1) * 5000),
    "HTTP": _sending(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n" * 1000),
    "an endless packet": _sending(struct.pack(">II", 60_000, 1) + b"x" * 50_000),
}
