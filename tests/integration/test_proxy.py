"""The proxy that other tests use to disturb connections does what they rely on."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from gateway.simulator.simulator import Simulator
from tests.integration.raw_client import RawClient, connected, consecutive, until
from tests.support.proxy import FuzzingProxy
from tests.unit.session.server.counting_scene import CountingScene
from tests.unit.session.server.wire import COMMAND, command, packet

VERSION = (COMMAND, b"OK-Version 1.0")
REPLY = packet(*VERSION)


@asynccontextmanager
async def proxied() -> AsyncIterator[tuple[Simulator, FuzzingProxy, RawClient]]:
    async with (
        Simulator(CountingScene(1000.0, num_markers=5000)) as simulator,
        FuzzingProxy(simulator.port) as proxy,
        connected(proxy) as client,
    ):
        await until(lambda: bool(simulator.connections) and proxy.num_connections == 1)
        yield simulator, proxy, client


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
    async with proxied() as (_, proxy, client):
        proxy.cut_after(len(REPLY) - 1)
        client.send(command("Version 1.0"))
        assert await client.rest() == REPLY[:-1]


async def test_a_direction_can_be_split_stalled_corrupt_or_slow(caplog: pytest.LogCaptureFixture) -> None:
    async with proxied() as (_, proxy, client):
        before = client.segments_received()
        proxy.to_client.segment_bytes = 3
        assert await client.ask("Version 1.0") == VERSION
        assert client.segments_received() > before + 2
        proxy.clear()
        proxy.to_client.stall()
        passed = proxy.to_client.passed_bytes
        client.send(command("Version 1.0"))
        await until(lambda: proxy.to_server.passed_bytes == 2 * len(command("Version 1.0")))
        assert proxy.to_client.passed_bytes == passed
        proxy.to_client.corrupt_share = 0.3
        proxy.to_client.resume()
        received = await client.exactly(len(REPLY))
        assert 0 < sum(byte != sent for byte, sent in zip(received, REPLY, strict=True)) < len(REPLY)
        proxy.clear()
        proxy.to_client.bytes_per_s = 10_000
        client.send(command("StreamFrames 3D"))
        await until(lambda: "does not read" in caplog.text)
        proxy.clear()
        assert await client.read() == (COMMAND, b"OK-StreamFrames 3D")
        assert consecutive(await client.frames(50))
