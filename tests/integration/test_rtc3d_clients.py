"""RTC3D clients of a gateway: what they get, also when something goes wrong, and how much they may use up."""

import struct
from dataclasses import dataclass

import pytest

from gateway.simulator.simulator import Simulator
from tests.integration.raw_client import connected, consecutive, until
from tests.support.gateways import playing, serving_gateway
from tests.support.networks import free_port
from tests.unit.session.server.counting_scene import CountingScene
from tests.unit.session.server.wire import (
    COMMAND,
    DATA,
    ERROR,
    EVENT,
    NO_DATA,
    command,
    packet,
)

START, STOP = (
    struct.pack(">IIIiqI", 1, 48, EVENT, -1, 0, 1) + struct.pack(">iqiii", event, 0, -1, -1, -1)
    for event in (1, 0)
)


@dataclass
class At:
    """Where a server will listen."""

    port: int


async def test_clients_stay_connected_until_the_server_is_there_and_while_it_restarts() -> None:
    address = At(free_port())
    async with serving_gateway(address, is_streaming=False) as gateway, connected(gateway) as client:
        assert await client.ask("StreamFrames 3D") == (COMMAND, b"OK-StreamFrames 3D")
        assert await client.read() == (NO_DATA, b"")
        async with Simulator(CountingScene(), port=address.port) as simulator:
            assert consecutive(await client.frames(10))
            simulator.crash()
            assert await client.reply() == (NO_DATA, b"")
            await simulator.start()
            assert consecutive(await client.frames(10))


def is_recording(simulator: Simulator) -> bool:
    return any(connection.session.is_recording for connection in simulator.connections)


async def test_recordings_are_passed_on_to_the_server_with_remote_control() -> None:
    async with playing(remote_control=True) as (simulator, gateway), connected(gateway) as client:
        for event, is_started in ((START, True), (STOP + b"\n", False)):
            client.send(packet(DATA, event))
            assert await client.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")
            assert is_recording(simulator) is is_started
        named = "Recording Start,file=take1.tsv,duration=900,durationunits=seconds"
        for text, is_started in ((named, True), ("Recording Stop", False)):
            assert await client.ask(text) == (COMMAND, f"OK-{text}".encode())
            assert is_recording(simulator) is is_started
        await client.ask("Recording Start,duration=0.01")
        await until(lambda: not is_recording(simulator))


@pytest.mark.parametrize("sent", [command("") * 400_000, command("x" * 60_000) * 300])
async def test_little_is_kept_of_what_a_client_sends_too_fast(sent: bytes) -> None:
    async with playing() as (_, gateway), connected(gateway) as flooding:
        flooding.send(sent)
        for _ in range(50):
            assert (await flooding.read())[0] == ERROR
            [connection] = gateway.server.connections
            num_bytes = sum(8 + len(each.body) for each in tuple(connection.waiting))
            assert num_bytes + connection._commands._reader.buffered_bytes < 70_000
