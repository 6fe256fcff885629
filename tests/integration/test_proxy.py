"""The proxy that other tests use to disturb connections."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from gateway.rtc3d_server.client_connection import MAX_UNREAD_BYTES
from gateway.simulator.simulator import Simulator
from tests.integration.raw_client import RawClient, connected, consecutive, until
from tests.proxy import FuzzingProxy
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.unit.rtc3d_server.wire import COMMAND, command, packet, packets_in

VERSION = (COMMAND, b"OK-Version 1.0")
REPLY = packet(*VERSION)


@asynccontextmanager
async def proxied(num_markers: int = 2) -> AsyncIterator[tuple[Simulator, FuzzingProxy, RawClient]]:
    async with (
        Simulator(CountingScene(1000.0, num_markers=num_markers)) as simulator,
        FuzzingProxy(simulator.port) as proxy,
        connected(proxy) as client,
    ):
        await until(lambda: bool(simulator.connections))
        yield simulator, proxy, client


async def test_the_proxy_passes_everything_in_both_directions_in_segments_of_any_size() -> None:
    async with proxied() as (_, proxy, client):
        await client.ask("StreamFrames 3D")
        assert consecutive(await client.frames(100))
        client.send(command("StreamFrames Stop"))
        await client.reply()
        before, passed = client.segments_received(), proxy.to_client.passed_bytes
        proxy.to_client.segment_bytes = 3
        for _ in range(10):
            assert await client.ask("Version 1.0") == VERSION
        assert client.segments_received() > before + 20
        assert proxy.to_client.passed_bytes == passed + 10 * len(REPLY)
        client.send(command("Bye"))
        assert packets_in(await client.rest())[-1] == (COMMAND, b"bye")
        await until(lambda: proxy.num_connections == 0)


async def test_a_cut_or_reset_reaches_both_sides_and_can_be_after_any_byte() -> None:
    async with proxied() as (simulator, proxy, client):
        proxy.cut()
        assert await client.rest() == b""
        await until(lambda: not simulator.connections)
        async with connected(proxy) as again:
            assert await again.ask("Version 1.0") == VERSION
            proxy.cut(reset=True)
            with pytest.raises(ConnectionResetError):
                await again.rest()
    for num_bytes in (1, 8, len(REPLY) - 1, len(REPLY)):
        async with proxied() as (_, proxy, client):
            proxy.cut_after(num_bytes)
            client.send(command("Version 1.0"))
            assert await client.rest() == REPLY[:num_bytes]


async def test_a_direction_can_stall_be_slow_and_corrupt_a_share_of_the_bytes(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with proxied(num_markers=5000) as (simulator, proxy, client):
        proxy.to_server.corrupt_share = 0.3
        proxy.to_client.stall()
        client.send(command("Version 1.0"))
        await until(lambda: proxy.to_server.passed_bytes == len(command("Version 1.0")))
        assert proxy.to_client.passed_bytes == 0
    async with proxied(num_markers=5000) as (simulator, proxy, client):
        proxy.to_client.corrupt_share = 0.3
        client.send(command("Version 1.0"))
        received = await client.exactly(len(REPLY))
        assert 0 < sum(byte != sent for byte, sent in zip(received, REPLY, strict=True)) < len(REPLY)
        proxy.clear()
        proxy.to_client.bytes_per_s = 10_000
        client.send(command("StreamFrames 3D"))
        await until(lambda: "does not read" in caplog.text)
        [connection] = simulator.connections
        assert connection.transport.get_write_buffer_size() > MAX_UNREAD_BYTES / 2
        proxy.clear()
        assert await client.read() == (COMMAND, b"OK-StreamFrames 3D")
        assert consecutive(await client.frames(50))
