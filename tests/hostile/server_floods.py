"""Servers that send too much, too small or contradictory packets, and parameters that take long to parse."""

import asyncio
import itertools
import os
import random
import struct
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from gateway.rtc3d.parameters_xml import MAX_XML_BYTES
from tests.hostile.servers import close_at_once, replying, streaming, streaming_flood
from tests.support.parameters import in_root
from tests.support.servers import Client, Script, error, markers_frame, ok, packet

MARKERS: Final = 1
EVENT: Final = 5
EXTREME_TIMES: Final = (-(2**63), 2**63 - 1, 0, -1, 1, 2**62, -(2**62), 2**32, 2**53)


def component(kind: int, number: int, timestamp_us: int, count: int, items: bytes = b"") -> bytes:
    return struct.pack(">IIiqI", 24 + len(items), kind, number, timestamp_us, count) + items


def frame(*components: bytes, count: int | None = None) -> bytes:
    """Return a type-3 packet; ``count`` replaces its component count with a wrong one."""
    return packet(3, struct.pack(">I", len(components) if count is None else count) + b"".join(components))


def tiny_frames() -> bytes:
    return b"".join(frame(component(MARKERS, n, 1000 * n, 0)) for n in range(20_000))


def layouts_of_equal_size() -> bytes:
    """Return frames of the same size, each with other components than the one before."""
    unknown = struct.pack(">I", 12)
    return b"".join(
        frame(*(unknown + struct.pack(">II", 100 + (n >> bit & 1), n) for bit in range(12)))
        for n in range(4096)
    )


def marker_counts() -> bytes:
    return b"".join(
        frame(component(MARKERS, n, 1000 * n, n % 200, bytes(16 * (n % 200)))) for n in range(2000)
    )


async def extreme_times(client: Client) -> None:
    """Stay at each extreme long enough for a clock, then jump, and jump in every frame at the end."""
    numbers = itertools.count(1)
    for time_us in itertools.cycle(EXTREME_TIMES):
        for step in range(300):
            at_us = min(max(time_us + 10_000 * step, -(2**63)), 2**63 - 1)
            client.send(frame(component(MARKERS, next(numbers) % 2**31, at_us, 0)))
            await asyncio.sleep(0.002)
        for other_us in EXTREME_TIMES:
            client.send(frame(component(MARKERS, (-1) ** next(numbers) * 2**30, other_us, 0)))


CONTROL: Final = "\x1b[2J\r\n2026-01-01 00:00:00,000 ERROR forged\n\x07\x9b31m\u202e\u2028\x7f"


async def texts(client: Client) -> None:
    """Send texts that try to control a terminal that shows the log."""
    for number in itertools.count():
        client.send(
            packet(0, f"{CONTROL} {number}".encode()) + packet(1, CONTROL * 1000) + packet(9, CONTROL)
        )
        await asyncio.sleep(0.01)


LABELS: Final = in_root(
    "<The_3D><Unit>\u202em\x9bm</Unit><Markers>"
    + "".join(f"<Marker id='{n}'><Label>\u2028\x9b31m{n}{'x' * 5000}</Label></Marker>" for n in range(20))
    + "</Markers></The_3D>"
)


FRESH: Final[dict[str, Any]] = {"parameters_interval_s": 0.5, "fresh_interval_s": 0.1}


def filled(before: str, unit: str, after: str = "") -> Callable[[int], bytes]:
    """Return the XML for the n-th request: as many of ``unit`` as the gateway still parses."""

    def xml(number: int) -> bytes:
        start = f"<RT_Parameters><General><Server><Name>{number}</Name></Server></General>{before}"
        end = f"{after}</RT_Parameters>"
        room = MAX_XML_BYTES - len(start) - len(end)
        return f"{start}{unit * (room // len(unit))}{end}".encode()

    return xml


PARAMETERS_XML: Final[dict[str, Callable[[int], bytes]]] = {
    "events": filled("<Events>", "<Event/>", "</Events>"),
    "markers": filled("<The_3D><Markers>", "<Marker/>", "</Markers></The_3D>"),
    "labels": filled("<The_3D><Markers>", "<Marker><Label>abcdefgh</Label></Marker>", "</Markers></The_3D>"),
    "numbers": filled(
        "<Analog><Channels>", "<Channel><Frequency>x</Frequency></Channel>", "</Channels></Analog>"
    ),
    "ampersands": filled("", "& "),
    "attributes": filled("<a ", "x='' ", "/>"),
    "too-large": lambda number: b"<RT_Parameters>%d" % number + b"<a/>" * 4_000_000,  # 16 MB
    "bomb": lambda number: (
        b"<!DOCTYPE a [<!ENTITY a '%d'><!ENTITY b '%b'>]><a>&b;</a>" % (number, b"&a;" * 5000)
    ),
}


def giving(xml: Callable[[int], bytes]) -> Script:
    numbers = itertools.count()

    def answer(command: str) -> bytes:
        if command.startswith("SendParameters"):
            return packet(2, xml(next(numbers)))
        return packet(4) if command.startswith("StreamFrames") else ok(f"OK-{command}")

    async def script(client: Client) -> None:
        await client.commands(answer)

    return script


# Servers that repeat themselves ---------------------------------------------------------------


async def refuse_with_new_words(client: Client) -> None:
    await client.commands(lambda _: error(f"no {random.random()}\x1b[2J\n{'x' * 1000}"))


async def alternate_states(client: Client) -> None:
    for number in range(1_000_000):
        client.send(packet(4) + markers_frame(number, (1.0, 2.0, 3.0)))
        await asyncio.sleep(0.005)


async def send_bad_frames(client: Client) -> None:
    while True:
        unknown = struct.pack(">III", 1, 8, random.randrange(10, 2**31))
        client.send(packet(3, random.choice([unknown, os.urandom(50)])))
        await asyncio.sleep(0.005)


async def restart_the_numbers(client: Client) -> None:
    for number in range(1_000_000):
        client.send(markers_frame(number % 7, *[(1.0, 2.0, 3.0)] * (1 + number % 3)))
        await asyncio.sleep(0.005)


# Servers that end the connection again and again ----------------------------------------------


async def break_after_a_frame(client: Client) -> None:
    client.send(markers_frame(1, (1.0, 2.0, 3.0)))
    await asyncio.sleep(0.02)
    client.cut()


async def half_close_after_a_frame(client: Client) -> None:
    client.send(markers_frame(1, (1.0, 2.0, 3.0)))
    client.end()
    await client.packet()


async def close_at_a_command(client: Client) -> None:
    await client.command()
    client.cut()


async def send_garbage(client: Client) -> None:
    client.send(os.urandom(1000))
    await client.commands(lambda _: os.urandom(100))


BREAKING: Final[dict[str, Script]] = {
    "break-after-a-frame": streaming(break_after_a_frame),
    "half-close-after-a-frame": streaming(half_close_after_a_frame),
    "close-at-once": close_at_once,
    "close-at-a-command": close_at_a_command,
    "garbage": send_garbage,
}


class Group(NamedTuple):
    """Servers that attack one gateway at the same time, and the settings of their sources."""

    servers: Mapping[str, Script]
    settings: Mapping[str, Any]


_ALL: Final = {"streams": [{"components": ["all"], "backlog": "all"}]}
_LATEST: Final = {"streams": [{"components": ["all"], "backlog": "latest"}]}

FLOODS: Final[dict[str, Group]] = {
    "tiny packets and long texts": Group(
        {
            "tiny-frames": streaming_flood(tiny_frames()),
            "empty-frames": streaming_flood(packet(3, bytes(4)) * 50_000),
            "no-frames": streaming_flood(packet(3) * 50_000),
            "no-data": streaming_flood(packet(4) * 50_000),
            "errors": streaming_flood(packet(0) * 50_000),
            "unknown-types": streaming_flood(packet(99) * 50_000),
            "data-then-none": streaming_flood((packet(4) + frame(component(MARKERS, 1, 1, 0))) * 10_000),
            "long-texts": streaming_flood(packet(1, b"ok " * 1_000_000)),
        },
        _ALL,
    ),
    "components": Group(
        {
            "two-million": streaming_flood(frame(struct.pack(">II", 8, 99) * 1_900_000, count=1_900_000)),
            "sixty-four": streaming_flood(frame(*[component(MARKERS, 1, 1, 0)] * 64) * 500),
            "equal-size": streaming_flood(layouts_of_equal_size()),
            "marker-counts": streaming_flood(marker_counts()),
            "frames": streaming_flood(
                b"".join(markers_frame(n, *[(1.0, 2.0, 3.0)] * 100) for n in range(1000))
            ),
        },
        _ALL,
    ),
    "only the latest": Group(
        {
            "tiny-frames": streaming_flood(tiny_frames()),
            "times": streaming(extreme_times),
            "texts": streaming(texts),
            "refusals": replying(default=error(CONTROL * 1000)),
            "labels": replying(SendParameters=packet(2, LABELS)),
            "new-words": refuse_with_new_words,
            "alternating": streaming(alternate_states),
            "bad-frames": streaming(send_bad_frames),
            "restarting-numbers": streaming(restart_the_numbers),
        },
        _LATEST,
    ),
    "parameters that take long": Group({name: giving(xml) for name, xml in PARAMETERS_XML.items()}, FRESH),
}
