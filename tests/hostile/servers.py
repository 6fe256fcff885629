"""Hostile RT servers, each a script for ``ScriptedServer``, in groups that one gateway can have at once.

``SERVERS`` has them by group and name. Some attack when a client connects, some in their replies, and some
after they have served a whole handshake.
"""

import asyncio
import itertools
import random
import struct
from collections.abc import Awaitable, Callable, Iterator
from typing import Final

from tests.support.parameters import in_root
from tests.support.servers import Client, Script, error, markers_frame, ok, packet

MIB: Final = 1 << 20
BLOCK_BYTES: Final = 20_000
PARAMETERS: Final = in_root(
    "<The_3D><Frequency>200</Frequency><Unit>mm</Unit><Markers>"
    "<Marker id='1'><Label>elbow</Label></Marker></Markers></The_3D>"
)
_CONTROL: Final = "\x1b[2J\r\n2026-01-01 ERROR forged line\n\x07\x9b" * 100

Reply = Callable[[str], bytes]
Attack = Callable[[Client], Awaitable[None]]


def reply_to(command: str) -> bytes:
    """Return the reply of a good server."""
    if command.startswith("SendParameters"):
        return packet(2, PARAMETERS)
    return ok(f"OK-{command}")


def good_frames(first: int = 1) -> Iterator[bytes]:
    """Yield frames of two markers without end."""
    for number in itertools.count(first):
        yield markers_frame(number, (1.0, 2.0, number % 7), (4.0, 5.0, 6.0))


async def flood(client: Client, data: bytes) -> None:
    """Send ``data`` again and again, as fast as the client takes it."""
    while True:
        client.send(data)
        await client.drain()


async def ignore(client: Client) -> None:
    """Read what the client sends, without an answer."""
    while True:
        await client.packet()


def replying(**replies: bytes | Reply) -> Script:
    """Return a server with other replies to some commands, by their first word; ``default`` is for all."""

    async def script(client: Client) -> None:
        def reply(command: str) -> bytes:
            given = replies.get(command.split(maxsplit=1)[0], replies.get("default", reply_to))
            return given if isinstance(given, bytes) else given(command)

        await client.commands(reply)

    return script


def streaming(attack: Attack) -> Script:
    """Return a server that serves a handshake, sends a few good frames and then attacks."""

    async def script(client: Client) -> None:
        command = ""
        while not command.startswith("StreamFrames"):
            command = await client.command()
            client.send(reply_to(command))
        for frame in itertools.islice(good_frames(), 20):
            client.send(frame)
        await attack(client)

    return script


def streaming_flood(data: bytes) -> Script:
    return streaming(lambda client: flood(client, data))


# Attacks when a client connects ---------------------------------------------------------------


async def random_bytes(client: Client) -> None:
    chance = random.Random(1)
    while True:
        client.send(chance.randbytes(4096))
        await client.drain()


async def web_server(client: Client) -> None:
    await client.packet()
    client.send(b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n<html><body>no</body></html>")


async def huge_packet(client: Client) -> None:
    client.send(struct.pack(">II", 0xFFFFFFFF, 3))
    await flood(client, bytes(MIB))


async def sizes_below_eight(client: Client) -> None:
    for size in range(8):
        client.send(struct.pack(">II", size, 3))
    await ignore(client)


async def slow_packet(client: Client) -> None:
    """A packet of 16 MiB that never becomes complete."""
    client.send(struct.pack(">II", 16 * MIB, 1))
    while True:
        client.send(b"x")
        await asyncio.sleep(0.01)


async def byte_by_byte(client: Client) -> None:
    """A good server that sends one byte at a time."""
    frames = good_frames()
    while True:
        command = await client.command()
        for byte in reply_to(command) + b"".join(itertools.islice(frames, 5)):
            client.send(bytes([byte]))
            await asyncio.sleep(0)


async def half_close(client: Client) -> None:
    client.end()
    await ignore(client)


async def reset(client: Client) -> None:
    client.reset()


async def close_at_once(_client: Client) -> None:
    return


async def never_read(_client: Client) -> None:
    await asyncio.sleep(3600)


# Attacks in replies ---------------------------------------------------------------------------

_ENTITIES: Final = "".join(f"<!ENTITY e{n} '{f'&e{n - 1};' * 10}'>" for n in range(1, 12))
XML_BOMB: Final = (
    f"<!DOCTYPE x [<!ENTITY e0 'ha'>{_ENTITIES}]>" + in_root("<The_3D><Unit>&e11;</Unit></The_3D>").decode()
).encode()
DEEP_XML: Final = in_root("<The_3D>" + "<Markers>" * 200_000 + "</Markers>" * 200_000 + "</The_3D>")
HUGE_LABELS: Final = in_root(
    "<The_3D><Markers>"
    + "".join(f"<Marker id='{n}'><Label>{'x' * MIB}</Label></Marker>" for n in range(1, 8))
    + "</Markers></The_3D>"
)
MANY_MARKERS: Final = in_root(
    "<The_3D><Markers>"
    + "".join(f"<Marker id='{n}'><Label>m{n}</Label></Marker>" for n in range(1, 50_001))
    + "</Markers></The_3D>"
)


def random_parameters(_command: str) -> bytes:
    chance = random.Random(2)
    damaged = bytearray(PARAMETERS)
    for _ in range(20):
        damaged[chance.randrange(len(damaged))] = chance.randrange(256)
    return packet(2, bytes(damaged))


# Attacks after a handshake --------------------------------------------------------------------


async def damaged_frames(client: Client) -> None:
    """Random changes of good frames, behind a right size, as fast as TCP takes them."""
    chance = random.Random(3)
    damaged = bytearray()
    for frame in good_frames():
        begin = len(damaged)
        damaged += frame
        for _ in range(chance.randrange(1, 4)):
            damaged[chance.randrange(begin + 8, len(damaged))] = chance.randrange(256)
        if len(damaged) > BLOCK_BYTES:
            client.send(bytes(damaged))
            damaged.clear()
            await client.drain()


async def unfinished_frame(client: Client) -> None:
    client.send(next(good_frames())[:-1])
    await ignore(client)


async def good_then_reset(client: Client) -> None:
    for frame in itertools.islice(good_frames(), 50):
        client.send(frame)
    await client.drain()
    client.reset()


async def endless_packet_types(client: Client) -> None:
    for packet_type in itertools.count(6):
        client.send(packet(packet_type & 0xFFFFFFFF, b"?") * 100)
        await client.drain()


def any_bits(value: int) -> bytes:
    """Return a frame whose numbers all have these 32 bits."""
    return packet(3, struct.pack(">III", 1, 24, 1) + struct.pack(">I", value) * 4)


EXTREME_FRAMES: Final = b"".join(
    any_bits(value) for value in (0, 1, 0x7F800000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
)
HUGE_FRAME: Final = markers_frame(1, *[(1.0, 2.0, 3.0)] * 100_000)


def taking_turns(*scripts: Script) -> Script:
    """Return a server that is another one at each connection."""
    turns = itertools.cycle(scripts)

    async def script(client: Client) -> None:
        await next(turns)(client)

    return script


GOOD_AFTER_ALL: Final = taking_turns(
    good_then_reset, replying(default=error("err-busy")), streaming(good_then_reset), random_bytes
)

SERVERS: Final[dict[str, dict[str, Script]]] = {
    "at the connection": {
        "random-bytes": random_bytes,
        "web-server": web_server,
        "huge-packet": huge_packet,
        "small-sizes": sizes_below_eight,
        "slow-packet": slow_packet,
        "byte-by-byte": byte_by_byte,
        "endless-text": lambda client: flood(client, b"220 smtp ready\r\n" * 1000),
        "endless-nothing": lambda client: flood(client, bytes(MIB)),
    },
    "ends of connections": {
        "half-close": half_close,
        "reset": reset,
        "close-at-once": close_at_once,
        "never-read": never_read,
        "mute": ignore,
        "good-then-reset": streaming(good_then_reset),
        "unfinished-frame": streaming(unfinished_frame),
        "takes-turns": GOOD_AFTER_ALL,
    },
    "replies": {
        "xml-bomb": replying(SendParameters=packet(2, XML_BOMB)),
        "deep-xml": replying(SendParameters=packet(2, DEEP_XML)),
        "huge-labels": replying(SendParameters=packet(2, HUGE_LABELS)),
        "many-markers": replying(SendParameters=packet(2, MANY_MARKERS)),
        "damaged-xml": replying(SendParameters=random_parameters),
        "only-errors": replying(default=error("err-" + "no " * 100_000)),
        "forged-lines": replying(default=error(_CONTROL), Version=ok(_CONTROL)),
        "other-types": replying(default=packet(2, b"<x/>") + packet(4) + packet(99)),
    },
    "packets of a stream": {
        "endless-errors": streaming_flood(error("err-" + _CONTROL) * 10),
        "endless-replies": streaming_flood(ok("OK-StreamFrames") * 1000),
        "endless-types": streaming(endless_packet_types),
        "endless-xml": streaming_flood(packet(2, PARAMETERS) * 10),
        "endless-files": streaming_flood(packet(5, b"no C3D file") * 100),
    },
    "frames": {
        "damaged-frames": streaming(damaged_frames),
        "many-components": streaming_flood(packet(3, b"\xff" * 1000) * 100),
        "extreme-numbers": streaming_flood(EXTREME_FRAMES * 100),
        "huge-frames": streaming_flood(HUGE_FRAME),
        "same-frame": streaming_flood(markers_frame(1, (1.0, 2.0, 3.0)) * 100),
        "wrong-order": streaming_flood(markers_frame(1, (1.0, 2.0, 3.0), order="<") * 100),
    },
}
