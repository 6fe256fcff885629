"""Faults of the whole server and of its sockets from a client's side."""

import asyncio
import contextlib
import socket
import struct

import numpy as np
import pytest

from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.rtc3d_server.client_connection import ClientConnection
from gateway.simulator.faults.base import Fault
from gateway.simulator.faults.kinds import KINDS
from gateway.simulator.faults.momentary_faults import Cut
from gateway.simulator.faults.reply_faults import LateAcknowledgements
from gateway.simulator.faults.server_faults import ChangeScene, NoMeasurement, Rename, Restart
from gateway.simulator.faults.stream_faults import Delay, HalfOpen, Merge, Split
from gateway.simulator.scene_settings import SceneSettings
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.integration.faulty import (
    FAST_HZ,
    NEVER_MS,
    VERSION,
    clear_and_check,
    only_connection,
    playing,
    waiting_bytes,
)
from tests.integration.raw_client import TIMEOUT_S, RawClient, connected, consecutive, numbers, until
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.unit.rtc3d_server.wire import (
    COMMAND,
    DATA,
    NO_DATA,
    XML,
    WireComponent,
    command,
    components_in,
    packets_in,
)

# The server ---------------------------------------------------------------------------------


async def test_the_measurement_can_stop_and_start() -> None:
    async with playing() as (simulator, client):
        await client.ask("StreamFrames 3D")
        await client.frames(5)
        first = simulator.faults.begin(NoMeasurement())
        second = simulator.faults.begin(NoMeasurement())
        assert await client.reply() == (NO_DATA, b"")
        simulator.faults.end(first)
        assert simulator.elapsed_us() is None
        simulator.faults.end(second)
        assert numbers(await client.frames(5)) == [1, 2, 3, 4, 5]
        await clear_and_check(simulator, client)


async def num_markers(client: RawClient) -> int:
    reply = await client.ask("SendParameters 3D")
    described = parse_parameters(reply[1]).parameters.markers
    assert described is not None
    return len(described.markers)


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
            assert await num_markers(again) == 12
            await again.ask("StreamFrames 3D")
            [[component]] = await again.frames(1)
            assert len(component.items) == 12
            assert component.timestamp_us == (component.frame_number - 1) * 2000
            assert only_connection(simulator).number == 1


async def test_a_restarted_server_comes_back_by_itself_with_its_old_scene() -> None:
    async with playing() as (simulator, client):
        scene = simulator.scene
        simulator.faults.begin(Restart(away_s=0))
        simulator.faults.begin(Restart(away_s=0.01))
        await client.rest()
        await until(lambda: simulator.is_listening)
        assert simulator.scene is scene
        async with connected(simulator) as again:
            await clear_and_check(simulator, again)


@pytest.mark.parametrize("rounds", range(6))
async def test_a_connection_that_was_just_accepted_ends_when_the_server_crashes(rounds: int) -> None:
    async with Simulator(CountingScene()) as simulator:
        with socket.create_connection(("127.0.0.1", simulator.port)) as client:
            client.setblocking(False)
            for _ in range(rounds):  # turns of the loop, in one of which the server accepts
                await asyncio.sleep(0)
            simulator.faults.begin(Restart(away_s=600))
            async with asyncio.timeout(TIMEOUT_S):
                with contextlib.suppress(ConnectionResetError):
                    assert await asyncio.get_running_loop().sock_recv(client, 1) == b""


@pytest.mark.parametrize("rounds", range(6))
async def test_a_server_that_is_about_to_come_back_can_be_restarted_again(rounds: int) -> None:
    async with playing() as (simulator, _):
        simulator.faults.end(simulator.faults.begin(Restart(away_s=600)))
        for _ in range(rounds):  # turns of the loop, in one of which the server comes back
            await asyncio.sleep(0)
        second = simulator.faults.begin(Restart(away_s=600))
        for _ in range(10):
            await asyncio.sleep(0)
        assert not simulator.is_listening
        simulator.faults.end(second)
        await until(lambda: simulator.is_listening)


async def test_a_restarted_server_plays_its_recording_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """With ``once``, each measurement waits for the first request for frames again."""
    monkeypatch.setattr("gateway.rtc3d_server.measurement.LEAD_US", 10_000)
    async with Simulator(CountingScene(FAST_HZ, num_frames=30), once=True) as simulator:
        for _ in range(2):
            async with connected(simulator) as client:
                await client.ask("StreamFrames 3D")
                assert numbers(await client.frames(30)) == list(range(1, 31))
                assert await client.read() == (NO_DATA, b"")
            simulator.faults.begin(Restart(away_s=0))
            await until(lambda: simulator.is_listening)


async def test_no_measurement_runs_after_a_restart_while_another_fault_prevents_it() -> None:
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


async def test_a_measurement_does_not_start_while_the_server_is_away() -> None:
    async with playing() as (simulator, _):
        no_measurement = simulator.faults.begin(NoMeasurement())
        simulator.faults.begin(Restart(away_s=600))
        simulator.faults.end(no_measurement)
        assert simulator.elapsed_us() is None
        await simulator.faults.clear()
        assert simulator.elapsed_us() is not None


async def test_a_server_whose_port_was_taken_comes_back_when_it_is_free(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another program may have taken the port meanwhile; the simulator says so and tries again."""
    monkeypatch.setattr("gateway.simulator.faults.control._RETRY_S", 0.01)
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


async def frames_up_to(client: RawClient, num_markers: int) -> list[list[WireComponent]]:
    frames: list[list[WireComponent]] = []
    async with asyncio.timeout(TIMEOUT_S):
        while not frames or len(frames[-1][0].items) != num_markers:
            frames += await client.frames(1)
    return frames


async def test_the_scene_changes_during_a_stream_and_back() -> None:
    async with playing() as (simulator, client):
        await client.ask("StreamFrames 3D")
        frames = await client.frames(5)
        scene = SceneSettings(markers=7, rate_hz=FAST_HZ, marker_label="M")
        change = simulator.faults.begin(ChangeScene(scene=scene))
        frames += await frames_up_to(client, num_markers=7)
        described = simulator.scene.parameters.markers
        assert described is not None
        assert [marker.label for marker in described.markers] == [f"M {k}" for k in range(1, 8)]
        simulator.faults.end(change)
        frames += await frames_up_to(client, num_markers=2)
        assert consecutive(frames)
        await clear_and_check(simulator, client)


async def test_a_changed_scene_keeps_the_scenarios_other_settings() -> None:
    async with playing() as (simulator, _):
        simulator.faults.play([], scene=SceneSettings(markers=3, tools=1, rate_hz=50))
        simulator.faults.begin(ChangeScene(scene=SceneSettings(markers=7)))
        assert simulator.scene.parameters.markers is not None
        assert simulator.scene.parameters.markers.frequency_hz == 50
        assert simulator.scene.parameters.tools is not None
        assert len(simulator.scene.parameters.tools.tools) == 1


async def test_names_can_change_while_frames_continue() -> None:
    scene = SyntheticScene(markers=2, tools=1, rate_hz=FAST_HZ)
    async with Simulator(scene) as simulator, connected(simulator) as client:

        async def labels() -> list[str]:
            _, xml = await client.ask("SendParameters 3D 6D")
            parameters = parse_parameters(xml).parameters
            assert parameters.markers is not None
            assert parameters.tools is not None
            markers = [marker.label for marker in parameters.markers.markers]
            return markers + [tool.label for tool in parameters.tools.tools]

        before = await labels()
        rename = simulator.faults.begin(Rename(prefix="Left "))
        assert await labels() == [f"Left {label}" for label in before]
        await client.ask("StreamFrames 3D")
        frames = await client.frames(5)
        simulator.faults.end(rename)
        frames += await client.frames(5)
        assert consecutive(frames)
        client.send(command("StreamFrames Stop"))
        assert simulator.scene is scene


# The byte stream ----------------------------------------------------------------------------


async def test_split_packets_come_in_several_segments() -> None:
    async with playing(100) as (simulator, client):
        simulator.faults.begin(Split(pieces=10, pause_ms=0.1))
        await client.ask("StreamFrames 3D")
        frames = await client.frames(20)
        assert client.segments_received() > 2 * 21
        assert consecutive(frames)


async def test_merged_packets_come_in_one_segment() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(Merge(window_ms=50))
        await client.ask("StreamFrames 3D")
        assert consecutive(await client.frames(200))
        assert client.segments_received() < 100
        await clear_and_check(simulator, client)


async def test_a_cut_ends_a_connection_within_a_packet() -> None:
    async with playing() as (simulator, client):
        await client.ask("StreamFrames 3D")
        simulator.faults.begin(Cut())
        rest = await client.rest()
        while len(rest) >= 8 and len(rest) >= (size := struct.unpack_from(">I", rest)[0]):
            rest = rest[size:]
        assert len(rest) > 8
        async with connected(simulator) as again:
            assert await again.ask("Version 1.0") == VERSION


async def test_a_cut_can_be_a_reset() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(Cut(reset=True))
        with pytest.raises(ConnectionResetError):
            await client.rest()


async def test_a_half_open_server_accepts_clients_but_neither_reads_nor_writes() -> None:
    async with playing() as (simulator, client):
        await client.ask("StreamFrames 3D")
        frames = await client.frames(5)
        half_open = simulator.faults.begin(HalfOpen())
        async with connected(simulator) as other:
            other.send(command("Version 1.0"))
            client.send(command("SendParameters General"))
            await until(
                lambda: waiting_bytes(simulator) == len(command("Version 1.0SendParameters General")) + 8
            )
            await until(lambda: half_open.num_happened > 50)
            assert not connection_with(simulator, 1).transport.is_reading()

            await simulator.faults.clear()

            assert await other.read() == VERSION
        while (reply := await client.read())[0] == DATA:
            frames.append(components_in(reply[1]))
        assert reply[0] == XML
        frames += await client.frames(5)
        assert np.diff(numbers(frames)).max() > 40
        await until(lambda: len(simulator.connections) == 1)
        await clear_and_check(simulator, client)


def connection_with(simulator: Simulator, number: int) -> ClientConnection:
    [connection] = [c for c in simulator.connections if c.number == number]
    return connection


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
    assert not simulator.is_listening
    assert not simulator.connections
    assert asyncio.all_tasks() == {asyncio.current_task()}


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS.keys())
async def test_the_server_recovers_from_any_fault_among_all_others(kind: type[Fault]) -> None:
    async with playing() as (simulator, client):
        await client.ask("StreamFrames")
        simulator.faults.begin(kind())
        for other in KINDS.values():
            if other is not Restart:
                simulator.faults.begin(other())
        await simulator.faults.clear()
        async with connected(simulator) as again:
            assert await again.ask("Version 1.0") == VERSION
            await again.ask("StreamFrames 3D")
            assert consecutive(await again.frames(20))
