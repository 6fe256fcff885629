"""RTC3D clients of a gateway: what they get, and what happens when something goes wrong."""

import asyncio
import struct

from gateway.config.settings import ReconnectSettings, SourceSettings, StreamSettings
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
    packet,
)

C3D = 5
START = struct.pack(">IIIiqI", 1, 48, EVENT, -1, 0, 1) + struct.pack(">iqiii", 1, 0, -1, -1, -1)
STOP = struct.pack(">IIIiqI", 1, 48, EVENT, -1, 0, 1) + struct.pack(">iqiii", 0, 0, -1, -1, -1)


# Parameters ---------------------------------------------------------------------------------


async def test_the_parameters_are_the_servers_own() -> None:
    async with playing(SyntheticScene(rate_hz=100)) as (_, gateway), connected(gateway) as client:
        xml = gateway.source.known_parameters.xml
        assert await client.ask("SendParameters") == (XML, xml)
        assert await client.ask("SendParameters All General") == (XML, xml)
        packet_type, part = await client.ask("SendParameters 3D Events")
    assert packet_type == XML
    whole, cut = parse_parameters(xml).parameters, parse_parameters(part).parameters
    assert cut == Parameters(markers=whole.markers, events=whole.events)


async def test_clients_get_changed_parameters() -> None:
    async with playing(parameters_interval_s=0.1) as (simulator, gateway), connected(gateway) as client:
        assert b"<Label>m1</Label>" in (await client.ask("SendParameters 3D"))[1]
        simulator.faults.begin(Rename(prefix="old "))
        async with asyncio.timeout(TIMEOUT_S):
            while b"<Label>m1</Label>" in (await client.ask("SendParameters 3D"))[1]:
                pass


class Nothing:
    """An address where nothing listens."""

    host = "127.0.0.1"

    def __init__(self) -> None:
        self.port = free_port()


# No measurement, no connection --------------------------------------------------------------


async def test_without_a_server_clients_get_no_data_and_frames_as_soon_as_it_is_there() -> None:
    nothing = Nothing()
    async with serving_gateway(nothing, is_streaming=False) as gateway, connected(gateway) as client:
        assert await client.ask("StreamFrames 3D") == (COMMAND, b"OK-StreamFrames 3D")
        assert await client.read() == (NO_DATA, b"")
        async with Simulator(CountingScene(), port=nothing.port):
            assert consecutive(await client.frames(10))


async def test_clients_stay_connected_while_the_server_restarts() -> None:
    async with playing() as (simulator, gateway), connected(gateway) as client:
        await client.ask("StreamFrames 3D")
        await client.frames(5)
        simulator.crash()
        assert await client.reply() == (NO_DATA, b"")
        await simulator.start()
        assert consecutive(await client.frames(10))


async def test_time_stamps_that_start_again_do_not_disturb_the_stream() -> None:
    async with playing() as (simulator, gateway), connected(gateway) as client:
        await client.ask("StreamFrames 3D Analog")
        await client.frames(5)
        simulator.stop_measurement()
        simulator.start_measurement()
        frames = await client.frames(60)
    first = numbers(frames).index(1)
    assert consecutive(frames[first:])
    for markers, analog in frames[first + 1 :]:
        assert analog.frame_number == 10 * markers.frame_number - 9


# On demand ----------------------------------------------------------------------------------


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
                frames = await client.frames(20)
                return consecutive(frames)

        assert all(await asyncio.gather(*(play(number) for number in range(100))))
        assert len(simulator.connections) == num_connections
        assert simulator._num_accepted == num_connections


# Recordings ---------------------------------------------------------------------------------


def is_recording(simulator: Simulator) -> bool:
    return any(connection.session.is_recording for connection in simulator.connections)


async def test_recordings_are_refused_in_plain_words_without_remote_control() -> None:
    async with playing() as (simulator, gateway), connected(gateway) as client:
        for sent in (
            packet(DATA, START),
            command("Recording Start,file=walk.c3d"),
            command("Recording Stop"),
        ):
            client.send(sent)
            packet_type, text = await client.read()
            assert packet_type == ERROR
            assert b"remote control is off for source 'lab'; to switch it on" in text
        assert await client.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")
        assert not is_recording(simulator)


async def test_recordings_are_passed_on_to_the_server_with_remote_control() -> None:
    async with playing(remote_control=True) as (simulator, gateway), connected(gateway) as client:
        client.send(packet(DATA, START))
        assert await client.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")
        assert is_recording(simulator)
        client.send(packet(DATA, STOP + b"\n"))
        assert await client.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")
        assert not is_recording(simulator)
        start = "Recording Start,file=walk.c3d"
        assert await client.ask(start) == (COMMAND, f"OK-{start}".encode())
        assert is_recording(simulator)
        assert await client.ask("Recording Stop") == (COMMAND, b"OK-Recording Stop")
        assert not is_recording(simulator)


# Ports and reloads --------------------------------------------------------------------------


def source(name: str, server: Simulator) -> SourceSettings:
    reconnect = ReconnectSettings(first_delay_s=0.01, max_delay_s=0.05)
    return SourceSettings(name=name, host="127.0.0.1", port=server.port, reconnect=reconnect)


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
            await reload(gateway, {"lab": gateway.port}, lab=simulator)
            assert consecutive(await client.frames(100))
            await reload(gateway, {"lab": hall}, lab=simulator)
            await client.rest()
        async with connected(At(hall)) as client:
            await client.ask("StreamFrames 3D")
            assert consecutive(await client.frames(10))


class At:
    def __init__(self, port: int) -> None:
        self.port = port


async def reload(gateway: ServingGateway, ports: dict[str, int], **servers: Simulator) -> None:
    """Reload with these sources and ports, as a configuration file would; wait until the ports are open."""
    settings = gateway.gateway.settings.model_copy(
        update={"sources": tuple(source(name, server) for name, server in servers.items())}
    )
    new = Rtc3dOutput(Rtc3dSettings(enabled=True, ports=ports))
    gateway.gateway._given_outputs = [new]
    await gateway.gateway.reload(settings)
    assert gateway.gateway.outputs == [gateway.output]
    await until(lambda: gateway.output.health().connected)
