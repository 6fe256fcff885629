"""A simulator with a client, and the check that both recover from faults."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from gateway.rtc3d_server.client_connection import ClientConnection
from gateway.simulator.simulator import Simulator
from tests.integration.raw_client import RawClient, connected, consecutive, until
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.unit.rtc3d_server.wire import COMMAND, command

FAST_HZ = 1000.0
NEVER_MS = 600_000
VERSION = (COMMAND, b"OK-Version 1.0")


@asynccontextmanager
async def playing(rate_hz: float = FAST_HZ) -> AsyncIterator[tuple[Simulator, RawClient]]:
    async with Simulator(CountingScene(rate_hz)) as simulator, connected(simulator) as client:
        await until(lambda: len(simulator.connections) == 1)
        yield simulator, client


def only_connection(simulator: Simulator) -> ClientConnection:
    [connection] = simulator.connections
    return connection


def waiting_bytes(simulator: Simulator) -> int:
    return sum(pipeline.waiting_bytes for pipeline in simulator.faults.connections)


async def clear_and_check(simulator: Simulator, client: RawClient) -> None:
    """Clear all faults, and check that the connection then works as without faults."""
    await simulator.faults.clear()
    assert simulator.faults.active_on(only_connection(simulator).number) == []
    assert waiting_bytes(simulator) == 0
    client.send(command("StreamFrames Stop"), command("Version 1.0"))
    while (await client.reply()) != VERSION:
        pass
    assert await client.ask("StreamFrames 3D") == (COMMAND, b"OK-StreamFrames 3D")
    frames = await client.frames(20)
    assert consecutive(frames)
    assert all(component.timestamp_us == (component.frame_number - 1) * 1000 for [component] in frames)
    assert all(component.items[1][1:] == (1.5, -2.0, 0.25) for [component] in frames)
