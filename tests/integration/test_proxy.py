"""The proxy that other tests use to disturb connections."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from gateway.rtc3d_server.client_connection import MAX_UNREAD_BYTES
from gateway.simulator.simulator import Simulator
from tests.integration.raw_client import RawClient, connected, consecutive, until
from tests.proxy import FuzzingProxy
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.unit.rtc3d_server.wire import COMMAND, command, packet, packets_in

FAST_HZ = 1000.0
VERSION = (COMMAND, b"OK-Version 1.0")


@asynccontextmanager
async def proxied(num_markers: int = 2) -> AsyncIterator[tuple[Simulator, FuzzingProxy, RawClient]]:
    async with (
        Simulator(CountingScene(FAST_HZ, num_markers=num_markers)) as simulator,
        FuzzingProxy(simulator.port) as proxy,
        connected(proxy) as client,
    ):
        yield simulator, proxy, client


async def test_the_proxy_passes_everything_in_both_directions() -> None:
    async with proxied() as (_, proxy, client):
        assert await client.ask("Version 1.0") == VERSION
        await client.ask("StreamFrames 3D")
        assert consecutive(await client.frames(100))
        client.send(command("Bye"))
        assert packets_in(await client.rest())[-1] == (COMMAND, b"bye")
        assert proxy.to_server.passed_bytes == len(
            command("Version 1.0") + command("StreamFrames 3D") + command("Bye")
        )
        await until(lambda: proxy.num_connections == 0)


async def test_each_client_has_its_own_connection_to_the_server() -> None:
    async with proxied() as (simulator, proxy, client), connected(proxy) as other:
        assert [await client.ask("Version 1.0"), await other.ask("Version 1.0")] == [VERSION] * 2
        assert (proxy.num_accepted, len(simulator.connections)) == (2, 2)


@pytest.mark.parametrize("reset", [False, True])
async def test_a_cut_reaches_both_sides(reset: bool) -> None:
    async with proxied() as (simulator, proxy, client):
        await client.ask("StreamFrames 3D")
        await client.frames(3)
        proxy.cut(reset=reset)
        if reset:
            with pytest.raises(ConnectionResetError):
                await client.rest()
        else:
            await client.rest()
        await until(lambda: not simulator.connections)
        async with connected(proxy) as again:
            assert await again.ask("Version 1.0") == VERSION


async def test_a_connection_can_be_cut_after_any_byte() -> None:
    reply = packet(*VERSION)
    for num_bytes in (1, 8, len(reply) - 1, len(reply)):
        async with proxied() as (simulator, proxy, client):
            await until(lambda: bool(simulator.connections))
            proxy.cut_after(num_bytes)
            client.send(command("Version 1.0"))
            assert await client.rest() == reply[:num_bytes]


async def test_a_vanished_server_refuses_connections_until_it_listens_again() -> None:
    async with proxied() as (_, proxy, client):
        assert await client.ask("Version 1.0") == VERSION
        proxy.vanish()
        with pytest.raises(ConnectionResetError):
            await client.rest()
        with pytest.raises(ConnectionRefusedError):
            await asyncio.open_connection("127.0.0.1", proxy.port)
        await proxy.listen()
        async with connected(proxy) as again:
            assert await again.ask("Version 1.0") == VERSION


async def test_one_direction_can_stall_while_the_other_passes_bytes() -> None:
    async with proxied() as (simulator, proxy, client):
        await until(lambda: bool(simulator.connections))
        [connection] = simulator.connections
        await client.ask("StreamFrames 3D")
        proxy.to_server.stall()
        client.send(command("StreamFrames Stop"))
        assert consecutive(await client.frames(200))
        proxy.to_client.stall()
        proxy.to_server.resume()
        await until(lambda: connection.due_us is None)
        passed = proxy.to_client.passed_bytes
        client.send(command("Version 1.0"))
        await until(
            lambda: proxy.to_server.passed_bytes > len(command("StreamFrames 3DStreamFrames Stop")) + 8
        )
        assert proxy.to_client.passed_bytes == passed
        proxy.clear()
        assert await client.reply() == (COMMAND, b"OK-StreamFrames Stop")
        assert await client.read() == VERSION


async def test_delayed_bytes_arrive_complete_and_in_order() -> None:
    async with proxied() as (_, proxy, client):
        proxy.to_client.delay_s = 0.01
        await client.ask("StreamFrames 3D")
        assert consecutive(await client.frames(100))


async def test_segments_can_be_small() -> None:
    async with proxied() as (_, proxy, client):
        proxy.to_client.segment_bytes = 3
        reply = packet(*VERSION)
        for _ in range(10):
            assert await client.ask("Version 1.0") == VERSION
        assert client.segments_received() > 20
        assert proxy.to_client.passed_bytes == 10 * len(reply)


async def test_the_same_seed_corrupts_the_same_bytes() -> None:
    received = []
    for seed in (1, 1, 2):
        async with Simulator(CountingScene()) as simulator, FuzzingProxy(simulator.port, seed=seed) as proxy:
            proxy.to_client.corrupt_share = 0.3
            async with connected(proxy) as client:
                client.send(command("Version 1.0"))
                received.append(await client.exactly(len(packet(*VERSION))))
                proxy.clear()
                assert await client.ask("Version 1.0") == VERSION
    differing = [byte != sent for byte, sent in zip(received[0], packet(*VERSION), strict=True)]
    assert 0 < sum(differing) < len(differing)
    assert received[0] == received[1] != received[2]


async def test_a_slow_reader_fills_the_buffers_of_the_server(caplog: pytest.LogCaptureFixture) -> None:
    async with proxied(num_markers=5000) as (simulator, proxy, client):
        proxy.to_client.bytes_per_s = 10_000
        client.send(command("StreamFrames 3D"))
        await until(lambda: "does not read" in caplog.text)
        [connection] = simulator.connections
        assert connection.transport.get_write_buffer_size() > MAX_UNREAD_BYTES / 2
        proxy.clear()
        assert await client.read() == (COMMAND, b"OK-StreamFrames 3D")
        assert consecutive(await client.frames(50))
        await until(lambda: simulator.frames_dropped > 0)


async def test_without_a_server_the_proxy_closes_connections_at_once() -> None:
    async with Simulator(CountingScene()) as simulator:
        port = simulator.port
    async with FuzzingProxy(port) as proxy, connected(proxy) as client:
        assert await client.rest() == b""
