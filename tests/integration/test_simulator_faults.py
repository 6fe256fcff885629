"""Faults of the whole server and of its sockets from a client's side."""

import asyncio
import contextlib
import socket
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.session.server.client_connection import ClientConnection
from gateway.simulator.faults import Cut, Delay, Fault, HalfOpen, Merge, NoMeasurement, Restart, Split
from gateway.simulator.packet_faults import LateAcknowledgements
from gateway.simulator.simulator import KINDS, Simulator
from gateway.simulator.synthetic import SceneSettings
from tests.integration.raw_client import TIMEOUT_S, RawClient, connected, consecutive, numbers, until
from tests.unit.session.server.counting_scene import CountingScene
from tests.unit.session.server.wire import COMMAND, NO_DATA, command, packets_in

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


# The server ---------------------------------------------------------------------------------


async def test_a_restarted_server_plays_its_recording_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """With ``once``, each measurement waits for the first request for frames again."""
    monkeypatch.setattr("gateway.session.server.measurement.LEAD_US", 10_000)
    async with Simulator(CountingScene(FAST_HZ, num_frames=30), once=True) as simulator:
        for _ in range(2):
            async with connected(simulator) as client:
                await client.ask("StreamFrames 3D")
                assert numbers(await client.frames(30)) == list(range(1, 31))
                assert await client.read() == (NO_DATA, b"")
            simulator.faults.begin(Restart(away_s=0))
            await until(lambda: simulator.is_listening)


async def test_a_server_whose_port_was_taken_comes_back_when_it_is_free(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another program may have taken the port meanwhile; the simulator says so and tries again."""
    monkeypatch.setattr("gateway.simulator.simulator._RETRY_S", 0.01)
    async with playing() as (simulator, client):
        restart = simulator.faults.begin(Restart(away_s=600))
        await client.rest()
        with socket.create_server(("127.0.0.1", simulator.port)):
            simulator.faults.end(restart)
            await until(lambda: f"port {simulator.port}: " in caplog.text)
            assert not simulator.is_listening
        await until(lambda: simulator.is_listening)
        async with connected(simulator) as again:
            assert await again.ask("Version 1.0") == VERSION


async def test_a_restarted_server_has_the_same_port_a_new_measurement_and_the_new_markers() -> None:
    async with playing() as (simulator, client):
        await client.ask("StreamFrames 3D")
        await client.frames(50)
        simulator.faults.begin(Restart(away_s=600, scene=SceneSettings(markers=12, rate_hz=500)))
        await client.rest()
        assert not simulator.is_listening
        with pytest.raises(ConnectionRefusedError):
            await asyncio.open_connection("127.0.0.1", simulator.port)
        await simulator.faults.clear()
        async with connected(simulator) as again:
            described = parse_parameters((await again.ask("SendParameters 3D"))[1]).parameters.markers
            assert described is not None
            await again.ask("StreamFrames 3D")
            [[component]] = await again.frames(1)
            assert (len(described.markers), len(component.items)) == (12, 12)
            assert component.timestamp_us == (component.frame_number - 1) * 2000
            assert only_connection(simulator).number == 1
        scene = simulator.scene
        simulator.faults.begin(Restart(away_s=0))
        simulator.faults.begin(Restart(away_s=0.01))
        await until(lambda: simulator.is_listening)
        assert simulator.scene is scene


async def test_no_measurement_runs_while_the_server_is_away_or_another_fault_prevents_it() -> None:
    async with playing() as (simulator, _):
        no_measurement = simulator.faults.begin(NoMeasurement())
        restart = simulator.faults.begin(Restart(away_s=600))
        simulator.faults.end(restart)
        await until(lambda: simulator.is_listening)
        async with connected(simulator) as again:
            await again.ask("StreamFrames 3D")
            assert await again.read() == (NO_DATA, b"")
            simulator.faults.end(no_measurement)
            assert numbers(await again.frames(3)) == [1, 2, 3]
        no_measurement = simulator.faults.begin(NoMeasurement())
        simulator.faults.begin(Restart(away_s=600))
        simulator.faults.end(no_measurement)
        assert simulator.elapsed_us() is None
        await simulator.faults.clear()
        assert simulator.elapsed_us() is not None


@pytest.mark.parametrize("rounds", range(6))
async def test_a_server_crashes_and_comes_back_whatever_it_is_about_to_do(rounds: int) -> None:
    """``rounds`` are turns of the event loop, in one of which the server accepts, or comes back."""
    async with Simulator(CountingScene()) as simulator:
        with socket.create_connection(("127.0.0.1", simulator.port)) as client:
            client.setblocking(False)
            for _ in range(rounds):
                await asyncio.sleep(0)
            first = simulator.faults.begin(Restart(away_s=600))
            async with asyncio.timeout(TIMEOUT_S):
                with contextlib.suppress(ConnectionResetError):
                    assert await asyncio.get_running_loop().sock_recv(client, 1) == b""
        simulator.faults.end(first)
        for _ in range(rounds):
            await asyncio.sleep(0)
        second = simulator.faults.begin(Restart(away_s=600))
        for _ in range(10):
            await asyncio.sleep(0)
        assert not simulator.is_listening
        simulator.faults.end(second)
        await until(lambda: simulator.is_listening)


# The byte stream ----------------------------------------------------------------------------


async def test_split_packets_come_in_several_segments_and_merged_ones_in_one() -> None:
    async with playing(100) as (simulator, client):
        simulator.faults.begin(Split(pieces=10, pause_ms=0.1))
        await client.ask("StreamFrames 3D")
        assert consecutive(await client.frames(20))
        assert client.segments_received() > 2 * 21
    async with playing() as (simulator, client):
        simulator.faults.begin(Merge(window_ms=50))
        await client.ask("StreamFrames 3D")
        assert consecutive(await client.frames(200))
        assert client.segments_received() < 100
        await clear_and_check(simulator, client)


async def test_a_cut_ends_a_connection_within_a_packet_or_resets_it() -> None:
    async with playing() as (simulator, client):
        await client.ask("StreamFrames 3D")
        simulator.faults.begin(Cut())
        rest = await client.rest()
        while len(rest) >= 8 and len(rest) >= (size := struct.unpack_from(">I", rest)[0]):
            rest = rest[size:]
        assert len(rest) > 8
        async with connected(simulator) as again:
            assert await again.ask("Version 1.0") == VERSION
            simulator.faults.begin(Cut(reset=True))
            with pytest.raises(ConnectionResetError):
                await again.rest()


async def test_bye_is_answered_before_the_connection_ends_despite_any_delay() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(Delay(delay_ms=NEVER_MS))
        simulator.faults.begin(LateAcknowledgements(delay_ms=NEVER_MS))
        client.send(command("Version 1.0"), command("Bye"))
        assert packets_in(await client.rest()) == [VERSION, (COMMAND, b"bye")]


# Any fault ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "fault", [Restart(away_s=600), HalfOpen(), Delay(delay_ms=NEVER_MS), NoMeasurement()]
)
async def test_a_simulator_closes_during_any_fault(fault: Fault) -> None:
    async with playing() as (simulator, client):
        client.send(command("StreamFrames 3D"))
        await client.read()
        simulator.faults.begin(fault)
        simulator.faults.play([Delay(at_s=600)])
        client.send(command("Version 1.0"))
        await asyncio.sleep(0)
    assert (simulator.is_listening, len(simulator.connections)) == (False, 0)
    assert asyncio.all_tasks() == {asyncio.current_task()}


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS.keys())
async def test_the_server_recovers_from_any_fault_among_all_others(kind: type[Fault]) -> None:
    async with playing() as (simulator, client):
        await client.ask("StreamFrames")
        for each in (kind, *(other for other in KINDS.values() if other is not Restart)):
            simulator.faults.begin(each())
        await simulator.faults.clear()
        async with connected(simulator) as again:
            assert await again.ask("Version 1.0") == VERSION
            await again.ask("StreamFrames 3D")
            assert consecutive(await again.frames(20))
