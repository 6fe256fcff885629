"""Attacks on the ports of outputs: most of them differ only in the bytes that are sent.

Attacks of viewers on the output ``foxglove`` are meant for a process of their own:

    python -m tests.hostile.port_attacks NAME PORT
"""

import asyncio
import contextlib
import itertools
import json
import os
import random
import socket
import struct
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Final

from tests.support.foxglove_viewer import PING, client_frame, upgrade_request
from tests.support.networks import free_port
from tests.support.vrpn_client import COOKIE, PING_TYPE, description, message
from tests.unit.session.server.wire import DATA, EVENT, command, packet

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


# RTC3D ----------------------------------------------------------------------------------------

_START: Final = struct.pack(">IIIiqI", 1, 48, EVENT, -1, 0, 1) + struct.pack(">iqiii", 1, 0, -1, -1, -1)
_WORDS: Final = ("3D", "6D", "Analog", "Force", "Events")
_CHOICES: Final = [
    " ".join(words) for count in range(1, 6) for words in itertools.combinations(_WORDS, count)
]
_FRAME_REQUESTS: Final = b"".join(
    command(f"{verb} {choice}") for choice in _CHOICES for verb in ("StreamFrames", "SendCurrentFrame")
)


def _frames_or_anything() -> bytes:
    return command("StreamFrames") if os.urandom(1)[0] % 2 else os.urandom(2000)


_ON_RTC3D: Final[dict[str, Attack]] = {
    "stalled clients": stalled(60, command("StreamFrames")),
    "silent connections": silent(150),  # more than are accepted
    "short connections": short(_frames_or_anything),
    "commands": endless(b"", command("Version 1.0") * 1000),
    "commands without reading": endless(b"", command("SendParameters") * 1000, reads=False),
    "requests for all choices": endless(b"", _FRAME_REQUESTS),
    "parameters of all choices": endless(
        b"", b"".join(command(f"SendParameters {choice}") for choice in _CHOICES)
    ),
    "recordings": endless(b"", packet(DATA, _START) + command("Recording Start,file=../x") * 10),
    "empty packets": endless(b"", packet(1) * 5000),
    "HTTP": endless(b"", b"GET / HTTP/1.1\r\nHost: x\r\n\r\n" * 1000),
    "an endless packet": endless(b"", struct.pack(">II", 60_000, 1) + b"x" * 50_000),
}


# VRPN -----------------------------------------------------------------------------------------

_DATAGRAMS_AT_ONCE: Final = 500

_TRACKERS: Final = b"".join(description(number, -1, f"Tool_{number % 9}") for number in range(2000))
_PINGS: Final = b"".join(message(number, PING_TYPE) for number in range(2000))


def _vrpn_garbage() -> bytes:
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


_ON_VRPN: Final[dict[str, Attack]] = {
    "stalled clients": stalled(60, COOKIE),
    "silent connections": silent(100),
    "pings": endless(COOKIE + description(PING_TYPE, -2, "vrpn_Base ping_message") + _TRACKERS, _PINGS),
    "descriptions": endless(COOKIE, _TRACKERS),
    "large messages": endless(COOKIE, message(0, 9, bytes(64_000)) * 4),
    "endless cookie": endless(b"vrpn: ver. 07.", b"7" * 65536),
    "HTTP": endless(b"", b"GET / HTTP/1.1\r\nHost: x\r\n\r\n" * 1000),
    "garbage": short(_vrpn_garbage),
    "requests by UDP": _callback_requests,
}


# LSL ------------------------------------------------------------------------------------------

_LSL_SEARCH_PORT: Final = 16571
_LSL_STREAM_PORTS: Final = range(16572, 16582)
"""liblsl takes the first free ports from 16572, one for each stream."""

_LSL_REQUEST: Final = (
    b"LSL:streamfeed/110 \r\nNative-Byte-Order: 1234\r\nMax-Buffer-Length: 2000000000\r\n"
    b"Max-Chunk-Length: 0\r\nProtocol-Version: 110\r\n\r\n"
)
_LSL_MISTAKES: Final = (
    b"LSL:streamfeed/ \r\n\r\n",
    b"LSL:streamfeed/99999999999999999999 x\r\n\r\n",
    b"LSL:streamfeed/110 \r\nNative-Byte-Order: x\r\nValue-Size: -1\r\nMax-Chunk-Length: -5\r\n\r\n",
    b"LSL:shortinfo\r\n" + b"[" * 10_000 + b"\r\n",
    b"LSL:shortinfo\r\nname='lab_3d' and not(not(position()=1))\r\n",
    b"GET / HTTP/1.1\r\n\r\n",
    b"\r\n" * 1000,
)


def _lsl_mistake() -> bytes:
    return random.choice((*_LSL_MISTAKES, os.urandom(1000)))


def _on_every_port(attack: Attack) -> Attack:
    async def on_every_port(_port: int) -> None:
        await asyncio.gather(*(together(attack)(port) for port in _LSL_STREAM_PORTS))

    return on_every_port


async def _lsl_datagrams(_port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        while True:
            for port in (_LSL_SEARCH_PORT, *_LSL_STREAM_PORTS):
                with contextlib.suppress(OSError):
                    sender.sendto(_lsl_mistake(), ("127.0.0.1", port))
            await asyncio.sleep(0.005)


_ON_LSL: Final[dict[str, Attack]] = {
    "endless line": _on_every_port(endless(b"", b"x" * 262_144)),  # which liblsl stores
    "silent connections": _on_every_port(silent(200)),
    "stalled receivers": _on_every_port(stalled(50, _LSL_REQUEST)),
    "mistakes": together(_on_every_port(short(_lsl_mistake)), _lsl_datagrams),
}
"""The ports are always the same."""


# Foxglove -------------------------------------------------------------------------------------

_KEY: Final = b"AAAAAAAAAAAAAAAAAAAAAA=="
_HANDSHAKE: Final = upgrade_request(_KEY, "foxglove.sdk.v1")
_CHANNELS: Final = [{"id": number, "channelId": number} for number in range(100)]
_SUBSCRIBE: Final = client_frame(json.dumps({"op": "subscribe", "subscriptions": _CHANNELS}).encode())
_UNSUBSCRIBE: Final = client_frame(
    json.dumps({"op": "unsubscribe", "subscriptionIds": list(range(100))}).encode()
)
_NO_REQUESTS: Final = (
    *(b"[" * 10_000, b"{}", b"1" * 5000),
    b'{"op":"subscribe","subscriptions":[{"id":-1}]}',
)
_16_EB: Final = bytes((0x81, 0xFF)) + b"\x7f" + b"\xff" * 7 + bytes(4)
_EMPTY_PIECES: Final = (b"\x00\x80" + bytes(4)) * 100

_ON_FOXGLOVE: Final[dict[str, Attack]] = {
    "garbage": together(
        endless(b"", os.urandom(5000)),
        endless(b"GET / HTTP/1.1\r\n", b"X: " + b"x" * 4000 + b"\r\n"),
        endless(_HANDSHAKE, os.urandom(5000)),
        short(lambda: upgrade_request(_KEY, "chat")),
    ),
    "half_open": together(silent(100), stalled(100, _HANDSHAKE[:60])),
    "huge": together(
        endless(_HANDSHAKE + _16_EB, bytes(100_000)),
        endless(_HANDSHAKE, client_frame(b'"' + b"x" * 1_000_000 + b'"')),
        endless(_HANDSHAKE + b"\x01\x80" + bytes(4), _EMPTY_PIECES),
    ),
    "requests": together(
        endless(_HANDSHAKE, b"".join(map(client_frame, _NO_REQUESTS))),
        endless(_HANDSHAKE, _SUBSCRIBE + _UNSUBSCRIBE),
        endless(_HANDSHAKE, client_frame(b"ping", PING) * 100),
    ),
    "stalled": stalled(200, _HANDSHAKE + _SUBSCRIBE),  # more than are accepted
    "connecting": together(*[short(lambda: _HANDSHAKE + _SUBSCRIBE)] * 4),
}


ATTACKS: Final[dict[str, dict[str, Attack]]] = {
    "rtc3d": _ON_RTC3D,
    "vrpn": _ON_VRPN,
    "lsl": _ON_LSL,
    "foxglove": _ON_FOXGLOVE,
}
"""The attacks on each output by name."""


if __name__ == "__main__":
    asyncio.run(repeating(ATTACKS["foxglove"][sys.argv[1]], int(sys.argv[2])))
