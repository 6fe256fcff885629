"""RTC3D clients of a gateway: what they get, also when something goes wrong, and how much they may use up."""

import asyncio
import logging
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from gateway.config.settings import ReconnectSettings, SourceSettings, StreamSettings
from gateway.losses import Loss
from gateway.outputs.contract import ServerFile
from gateway.outputs.guard import GuardedOutput
from gateway.outputs.rtc3d.live_server import SLOW_CLIENT
from gateway.outputs.rtc3d.output import Rtc3dOutput
from gateway.outputs.rtc3d.settings import Rtc3dSettings
from gateway.rtc3d.parameters import Parameters
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.simulator.faults.server_faults import Rename
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.stream.state import StreamState
from tests.integration.raw_client import TIMEOUT_S, connected, consecutive, numbers, until
from tests.networks import free_port
from tests.serving_gateway import ServingGateway, playing, serving_gateway
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.unit.rtc3d_server.wire import (
    COMMAND,
    DATA,
    ERROR,
    EVENT,
    NO_DATA,
    XML,
    command,
    components_in,
    packet,
)

C3D = 5
START, STOP = (
    struct.pack(">IIIiqI", 1, 48, EVENT, -1, 0, 1) + struct.pack(">iqiii", event, 0, -1, -1, -1)
    for event in (1, 0)
)


@dataclass
class At:
    """An address."""

    port: int
    host: str = "127.0.0.1"


# The server ---------------------------------------------------------------------------------


async def test_the_parameters_are_the_servers_own_also_after_a_change() -> None:
    scene = SyntheticScene(rate_hz=100)
    async with (
        playing(scene, parameters_interval_s=0.1) as (simulator, gateway),
        connected(gateway) as client,
    ):
        xml = gateway.source.known_parameters.xml
        assert await client.ask("SendParameters") == (XML, xml)
        assert await client.ask("SendParameters All General") == (XML, xml)
        packet_type, part = await client.ask("SendParameters 3D Events")
        assert packet_type == XML
        whole, cut = parse_parameters(xml).parameters, parse_parameters(part).parameters
        assert cut == Parameters(markers=whole.markers, events=whole.events)
        simulator.faults.begin(Rename(prefix="old "))
        async with asyncio.timeout(TIMEOUT_S):
            while b"<Label>old " not in (await client.ask("SendParameters 3D"))[1]:
                pass


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


async def test_the_server_sends_frames_only_while_a_client_asks_for_some() -> None:
    streams = (StreamSettings(on_demand=True, idle_after_s=0.1),)
    async with playing(streams=streams) as (_, gateway):
        [status] = gateway.source.statuses
        await until(lambda: status.state is StreamState.IDLE)
        async with connected(gateway) as client:
            await client.ask("Version 1.0")
            await client.ask("StreamFrames 3D")
            assert consecutive(await client.frames(30))
            assert await client.ask_while_streaming("StreamFrames Stop") == b"OK-StreamFrames Stop"
            await until(lambda: status.state is StreamState.IDLE)
            frames = []
            for _ in range(3):
                assert await client.ask("SendCurrentFrame 3D") == (COMMAND, b"OK-SendCurrentFrame 3D")
                frames += await client.frames(1)
            assert numbers(frames) == sorted(set(numbers(frames)))
            await until(lambda: status.state is StreamState.IDLE)


async def test_a_hundred_clients_share_one_session_with_the_server() -> None:
    async with playing() as (simulator, gateway):
        num_connections = len(simulator.connections)

        async def play(number: int) -> bool:
            async with connected(gateway) as client:
                await client.ask(f"StreamFrames {('3D', '6D', 'All')[number % 3]}")
                return consecutive(await client.frames(20))

        assert all(await asyncio.gather(*(play(number) for number in range(100))))
        assert len(simulator.connections) == simulator._num_accepted == num_connections


def is_recording(simulator: Simulator) -> bool:
    return any(connection.session.is_recording for connection in simulator.connections)


async def test_recordings_are_refused_in_plain_words_without_remote_control() -> None:
    async with playing() as (simulator, gateway), connected(gateway) as client:
        for sent in (packet(DATA, START), command("Recording Start,file=x.c3d"), command("Recording Stop")):
            client.send(sent)
            packet_type, text = await client.read()
            assert packet_type == ERROR
            assert b"remote control is off for source 'lab'; to switch it on" in text
        assert await client.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")
        assert not is_recording(simulator)


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


# Reloads ------------------------------------------------------------------------------------


async def test_a_reload_opens_and_closes_ports_and_the_other_clients_stay() -> None:
    async with playing() as (simulator, gateway), Simulator(CountingScene()) as second:
        await gateway.gateway.opened.wait()
        async with connected(gateway) as client:
            await client.ask("StreamFrames 3D")
            hall = free_port()
            await reload(gateway, {"lab": gateway.port, "hall": hall}, lab=simulator, hall=second)
            async with connected(At(hall)) as other:
                await other.ask("StreamFrames 3D")
                assert consecutive(await other.frames(10))
                await reload(gateway, {"lab": gateway.port}, lab=simulator, hall=second)
                await other.rest()
            assert consecutive(await client.frames(100))
            await reload(gateway, {"lab": hall}, lab=simulator)
            await client.rest()
        async with connected(At(hall)) as client:
            await client.ask("StreamFrames 3D")
            assert consecutive(await client.frames(10))


async def reload(gateway: ServingGateway, ports: dict[str, int], **servers: Simulator) -> None:
    """Reload with these sources and ports, as a configuration file would; wait until the ports are open."""
    common: dict[str, Any] = {
        "host": "127.0.0.1",
        "reconnect": ReconnectSettings(first_delay_s=0.01, max_delay_s=0.05),
    }
    sources = tuple(SourceSettings(name=name, port=each.port, **common) for name, each in servers.items())
    settings = gateway.gateway.settings.model_copy(update={"sources": sources})
    gateway.gateway._given_outputs = [GuardedOutput(Rtc3dOutput(Rtc3dSettings(enabled=True, ports=ports)))]
    await gateway.gateway.reload(settings)
    assert [each.output for each in gateway.gateway.outputs] == [gateway.output]
    await until(lambda: gateway.output.health().connected)


# Files and limits ---------------------------------------------------------------------------


def events_in(body: bytes) -> list[int]:
    return [int(item[0]) for each in components_in(body) if each.type == EVENT for item in each.items]


async def test_a_file_of_the_server_is_passed_on_whole_between_frames(tmp_path: Path) -> None:
    content = bytes(range(256)) * 40_000  # longer than what waits in memory
    path = tmp_path / "walk.c3d"
    path.write_bytes(content)
    async with (
        playing() as (_, gateway),
        connected(gateway) as client,
        connected(gateway) as half_open,
    ):
        await client.ask("StreamFrames All")
        await client.frames(3)
        gateway.gateway._announce_file("lab", ServerFile(path, len(content)))
        received = [await client.read()]
        while received[-1][0] == DATA:
            received.append(await client.read())
        assert received.pop() == (C3D, content)
        received += [await client.read() for _ in range(30)]
        assert {packet_type for packet_type, _ in received} == {DATA}
        events = [each for _, body in received for each in events_in(body)]
        assert events == list(range(events[0], events[0] + len(events)))
        half_open.send(command("Version 1.0"))
        assert await half_open.read() == (COMMAND, b"OK-Version 1.0")  # and no file before it


def losses_of(gateway: ServingGateway) -> Sequence[Loss]:
    [(_, status)] = gateway.source.fan_out.outputs
    losses: Sequence[Loss] = status.losses
    return losses


async def test_a_slow_client_loses_only_its_own_frames_and_no_event(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.WARNING)
    scene = CountingScene(150.0, num_markers=3000)
    async with playing(scene) as (_, gateway), connected(gateway) as slow, connected(gateway) as other:
        slow.pause()
        slow.send(command("StreamFrames 3D Events"))
        await other.ask("StreamFrames 6D")
        while "lab to rtc3d: client" not in caplog.text or not losses_of(gateway):
            assert consecutive(await other.frames(20))
        assert {loss.cause for loss in losses_of(gateway)} == {SLOW_CLIENT}

        slow.resume()
        assert (await slow.read())[0] == COMMAND
        events: list[int] = []
        previous = 0
        has_gap = False
        while not has_gap or len(events) < 5:
            packet_type, body = await slow.read()
            assert packet_type == DATA
            events += events_in(body)
            number = struct.unpack_from(">i", body, 12)[0]
            has_gap = has_gap or bool(previous and number > previous + 1)
            previous = number
        assert events == list(range(events[0], events[0] + len(events)))
    # On a busy computer, the gateway itself may be a client that does not read in time.
    assert caplog.text.count("lab to rtc3d: client") == 1


@pytest.mark.parametrize("sent", [command("") * 400_000, command("x" * 60_000) * 300])
async def test_little_is_kept_of_what_a_client_sends_too_fast(sent: bytes) -> None:
    async with playing() as (_, gateway), connected(gateway) as flooding:
        flooding.send(sent)
        for _ in range(50):
            assert (await flooding.read())[0] == ERROR
            [connection] = gateway.server.connections
            num_bytes = sum(8 + len(each.body) for each in connection._inbox)
            assert num_bytes + connection._reader.buffered_bytes < 70_000
