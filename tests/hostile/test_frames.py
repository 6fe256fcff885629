"""Servers that send too much, too small or contradictory packets as fast as TCP takes them, and any time."""

import asyncio
import itertools
import struct
from collections.abc import Mapping
from contextlib import AsyncExitStack
from typing import Final

import pytest

from tests.hostile.gateway_under_attack import GatewayUnderAttack
from tests.hostile.servers import flood, replying, streaming, streaming_flood
from tests.servers import Client, Script, ScriptedServer, error, markers_frame, packet
from tests.spec_parameters import in_root

pytestmark = pytest.mark.netns

ATTACK_S: Final = 3.0

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

ATTACKS: Final[Mapping[str, Mapping[str, Script]]] = {
    "tiny packets": {
        "tiny-frames": streaming_flood(tiny_frames()),
        "empty-frames": streaming_flood(packet(3, bytes(4)) * 50_000),
        "no-frames": streaming_flood(packet(3) * 50_000),
        "no-data": streaming_flood(packet(4) * 50_000),
    },
    "texts at full speed": {
        "errors": streaming_flood(packet(0) * 50_000),
        "unknown-types": streaming_flood(packet(99) * 50_000),
        "data-then-none": streaming_flood((packet(4) + frame(component(MARKERS, 1, 1, 0))) * 10_000),
        "long-texts": streaming_flood(packet(1, b"ok " * 1_000_000)),
    },
    "components": {
        "two-million": streaming_flood(frame(struct.pack(">II", 8, 99) * 1_900_000, count=1_900_000)),
        "sixty-four": streaming_flood(frame(*[component(MARKERS, 1, 1, 0)] * 64) * 500),
        "equal-size": streaming_flood(layouts_of_equal_size()),
        "marker-counts": streaming_flood(marker_counts()),
    },
    "bytes at full speed": {
        "frames": streaming_flood(b"".join(markers_frame(n, *[(1.0, 2.0, 3.0)] * 100) for n in range(1000))),
        "latest": streaming_flood(tiny_frames()),
    },
    "times and texts": {
        "times": streaming(extreme_times),
        "texts": streaming(texts),
        "refusals": replying(default=error(CONTROL * 1000)),
        "labels": replying(SendParameters=packet(2, LABELS)),
    },
}


@pytest.mark.parametrize("group", ATTACKS)
async def test_floods_and_extremes_harm_nobody(group: str, gateway_under_attack: GatewayUnderAttack) -> None:
    async with AsyncExitStack() as stack:
        attackers = {}
        for name, script in ATTACKS[group].items():
            server = await stack.enter_async_context(ScriptedServer(script))
            attackers[name] = {"port": server.port, "streams": [{"components": ["all"], "backlog": "all"}]}
        if "latest" in attackers:
            attackers["latest"]["streams"] = [{"components": ["all"], "backlog": "latest"}]
        async with gateway_under_attack(attackers) as gateway:
            await asyncio.sleep(ATTACK_S)
    gateway.report.check()
    assert all(line.isprintable() for line in gateway.log.splitlines())
    assert max(map(len, gateway.log.splitlines())) < 3000


async def test_a_flood_is_served_while_it_lasts(gateway_under_attack: GatewayUnderAttack) -> None:
    """The others do not wait, and neither does the one that floods: each turn serves it a little."""

    async def attack(client: Client) -> None:
        await flood(client, tiny_frames())

    async with (
        ScriptedServer(streaming(attack)) as server,
        gateway_under_attack({"x": server.port}) as gateway,
    ):
        await asyncio.sleep(ATTACK_S)
        page = await gateway_metrics(gateway.metrics_port)
    gateway.report.check()
    [received] = [
        float(line.split()[-1])
        for line in page.splitlines()
        if line.startswith("rtc3d_gateway_frames_received_total") and 'source="x"' in line
    ]
    assert received > 10_000


async def gateway_metrics(port: int) -> str:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
    page = await reader.read()
    writer.close()
    return page.decode()
