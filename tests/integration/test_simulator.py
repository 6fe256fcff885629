"""The simulator from a client's side, directly and through a gateway: hand-made packets over TCP."""

import asyncio
import logging
import struct
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import replace

import pytest

from gateway.errors import GatewayError
from gateway.rtc3d.parameters import General
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.session.server.client_connection import LIMITS
from gateway.session.server.server import RtServer
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.integration.raw_client import (
    TIMEOUT_S,
    Listening,
    RawClient,
    connected,
    consecutive,
    numbers,
    until,
)
from tests.support.errors import each_names
from tests.support.gateways import serving_gateway
from tests.support.needs import need_ipv6
from tests.unit.session.server.counting_scene import CountingScene
from tests.unit.session.server.wire import (
    ANALOG,
    COMMAND,
    DATA,
    ERROR,
    EVENT,
    FORCE,
    MARKERS,
    NO_DATA,
    TOOLS,
    XML,
    command,
    components_in,
    packet,
    packets_in,
)

KEYS = {MARKERS: "3d", TOOLS: "6d", ANALOG: "analog", FORCE: "force", EVENT: "event"}
RATE_HZ = 100.0
FAST_HZ = 1000.0
"""For clients of the simulator itself; a gateway in the same process has twice the work."""
VERSION = (COMMAND, b"OK-Version 1.0")

Served = Callable[..., AbstractAsyncContextManager[Listening]]
"""Takes a simulator; yields the server that clients connect to."""


@asynccontextmanager
async def directly(simulator: Simulator) -> AsyncIterator[Listening]:
    yield simulator


@asynccontextmanager
async def through_a_gateway(simulator: Simulator) -> AsyncIterator[Listening]:
    async with serving_gateway(simulator) as gateway:
        yield gateway


@pytest.fixture(params=[directly, through_a_gateway])
def served(request: pytest.FixtureRequest) -> Served:
    """How clients reach a simulator: both must get the same."""
    serve: Served = request.param
    return serve


@asynccontextmanager
async def playing(served: Served) -> AsyncIterator[tuple[Simulator, RawClient]]:
    async with (
        Simulator(CountingScene(RATE_HZ)) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        yield simulator, client


def general_in(xml: bytes) -> General:
    general = parse_parameters(xml).parameters.general
    assert general is not None
    return general


# The protocol -------------------------------------------------------------------------------


async def test_a_client_can_follow_the_order_of_the_specification(served: Served) -> None:
    """Every packet is sent with one send."""
    async with (
        Simulator(SyntheticScene(rate_hz=RATE_HZ)) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        assert await client.ask("Version 1.0\0") == VERSION
        assert await client.ask("SetByteOrder BigEndian") == (COMMAND, b"OK-SetByteOrder BigEndian")
        packet_type, xml = await client.ask("SendParameters All")
        general, parameters = general_in(xml), parse_parameters(xml).parameters
        assert (packet_type, general.name) == (XML, "RTC3D simulator")
        assert (general.address, general.port) == ("127.0.0.1", simulator.port)
        assert replace(parameters, general=None) == simulator.scene.parameters
        assert await client.ask("StreamFrames") == (COMMAND, b"OK-StreamFrames")
        sizes = [
            [(each.type, len(each.items)) for each in components if each.type != EVENT]
            for components in await client.frames(20)
        ]
        # A gateway sends a frame without what its server did not send in time.
        assert max(sizes, key=len) == [(MARKERS, 20), (TOOLS, 2), (ANALOG, 8), (FORCE, 2)]
        num_packets = 24
        # The next packets arrive meanwhile, and TCP divides a few while this client is slow.
        while num_packets < 60 or client.segments_received() > 1.5 * num_packets:
            await client.read()
            num_packets += 1
            assert num_packets < 1000, "packets are sent in several parts"
        client.send(command("Bye"), command("Version 1.0"))
        assert packets_in(await client.rest())[-1] == (COMMAND, b"bye")


async def test_commands_can_arrive_in_pieces_or_several_at_once(served: Served) -> None:
    """A client that closes its sending half gets all answers."""
    async with playing(served) as (_, client):
        bunch = command("Version 1.0") + command("SetByteOrder LittleEndian") + command("Version 1.0")
        for byte in bunch:
            client.send(bytes([byte]))
            await client.writer.drain()
        client.send(bunch)
        replies = [(await client.read())[1] for _ in range(6)]
        assert replies == [b"OK-Version 1.0", b"OK-SetByteOrder LittleEndian", b"OK-Version 1.0"] * 2
        client.send(command("Version 1.0") * 300, command("SendCurrentFrame 3D"), command("Fly"))
        client.writer.write_eof()
        kinds = [each[0] for each in packets_in(await client.rest())]
        assert sorted(kinds) == [ERROR, *[COMMAND] * 301, DATA]


@pytest.mark.parametrize("size", [7, 64 * 1024 + 1])
async def test_a_size_out_of_bounds_gets_an_error_packet_and_ends_the_connection(
    served: Served, size: int
) -> None:
    async with playing(served) as (_, client):
        client.send(command("Version 1.0"), struct.pack(">II", size, COMMAND))
        [reply, (packet_type, text)] = packets_in(await client.rest())
        assert (reply, packet_type) == (VERSION, ERROR)
        assert str(size).encode() in text


async def test_names_of_clients_have_brackets_if_the_address_is_one_of_ipv6(
    caplog: pytest.LogCaptureFixture,
) -> None:
    need_ipv6()
    caplog.set_level(logging.INFO)
    async with RtServer(CountingScene(), host="::1") as server:
        reader, writer = await asyncio.open_connection("::1", server.port)
        writer.write(command("Bye"))
        await reader.read()
        writer.close()
        port = writer.get_extra_info("sockname")[1]
        await until(lambda: f"[::1]:{port}: disconnected" in caplog.text)


async def test_commands_are_logged_as_debug(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG", "gateway.session.server")
    async with Simulator(CountingScene()) as simulator, connected(simulator) as client:
        await client.ask("Version 1.0\0")
        await client.ask("x" * 1000)
        client.send(packet(DATA, b"\0\0\0\0"))
        await client.read()
    received = [text.split(" received ")[1] for text in caplog.messages if " received " in text]
    assert received[:2] == [r"'Version 1.0\x00'", repr("x" * 200)]
    assert each_names(received[2:], ["type 3", "4 bytes"])


async def test_the_end_and_the_start_of_a_measurement_reach_a_client(served: Served) -> None:
    """No Data ends a stream and answers requests (§5.3.4, §5.3.5); frames then begin with the first one."""
    async with playing(served) as (simulator, client):
        for _ in range(5):
            client.send(command("SendCurrentFrame 3D"))
            assert await client.read() == (COMMAND, b"OK-SendCurrentFrame 3D")
            await client.frames(1)
        await client.ask("StreamFrames 3D")
        await client.frames(5)
        simulator.stop_measurement()
        assert await client.reply() == (NO_DATA, b"")
        assert await client.ask("SendCurrentFrame") == (COMMAND, b"OK-SendCurrentFrame")
        assert await client.read() == (NO_DATA, b"")
        assert (await client.ask("SendParameters"))[0] == XML
        simulator.start_measurement()
        assert numbers(await client.frames(5)) == [1, 2, 3, 4, 5]


# Many clients, statistics and the end --------------------------------------------------------


async def test_a_client_that_does_not_read_delays_no_other_and_continues_when_it_reads(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.WARNING)
    scene = CountingScene(FAST_HZ, num_markers=5000)
    async with Simulator(scene) as simulator, connected(simulator) as silent:
        silent.pause()
        silent.send(command("StreamFrames 3D Events"))
        await until(lambda: "does not read" in caplog.text)
        [full] = simulator.connections
        async with connected(simulator) as reading:
            await reading.ask("StreamFrames 6D")
            assert consecutive(await reading.frames(300))
        assert full.transport.get_write_buffer_size() < LIMITS.unread_bytes + 2**20
        assert simulator.frames_dropped > 100

        silent.resume()
        assert (await silent.read())[0] == COMMAND
        frames = await silent.frames(full.sent.number + 50)
        assert not consecutive(frames)
        events = [each for frame in frames for each in frame if each.type == EVENT]
        ids = [event[0] for component in events for event in component.items]
        assert ids == list(range(1, len(ids) + 1))
        assert len(ids) >= 4
        dropped = simulator.frames_dropped
    assert simulator.frames_dropped >= dropped
    assert caplog.text.count("does not read") == 1


async def test_sent_frames_are_counted_for_each_client_and_in_total() -> None:
    received: Counter[str] = Counter()
    num_frames = 0
    async with Simulator(CountingScene(FAST_HZ)) as simulator:
        for sent in ("StreamFrames 3D Events", "StreamFrames All"):
            async with connected(simulator) as client:
                general = general_in((await client.ask("SendParameters General"))[1])
                assert (general.frames_sent, general.frames_per_s) == (0, 0.0)
                await client.ask(sent)
                frames = await client.frames(150)
                client.send(command("StreamFrames Stop"), command("SendParameters General"))
                while (reply := await client.read())[0] != COMMAND:
                    frames.append(components_in(reply[1]))
                general = general_in((await client.read())[1])
                assert general.frames_sent == len(frames)
                assert (general.frames_per_s or 0) > 0
                received.update(KEYS[component.type] for components in frames for component in components)
                num_frames += len(frames)
        assert (simulator.components_sent, simulator.frames_sent) == (received, num_frames)


async def test_closing_sends_no_data_waits_for_nobody_and_frees_the_port(
    caplog: pytest.LogCaptureFixture,
) -> None:
    simulator = Simulator(CountingScene(FAST_HZ, num_markers=5000))
    await simulator.start()
    async with connected(simulator) as client, connected(simulator) as silent:
        silent.pause()
        silent.send(command("StreamFrames"))
        await until(lambda: "does not read" in caplog.text)
        await client.ask("StreamFrames 6D")
        await client.frames(1)
        async with asyncio.timeout(TIMEOUT_S):
            await simulator.close()
        assert packets_in(await client.rest())[-1] == (NO_DATA, b"")
        await until(lambda: not simulator.connections)
    async with Simulator(CountingScene(), port=simulator.port) as again:
        with pytest.raises(GatewayError, match=f"127.0.0.1, port {simulator.port}: .*free"):
            await Simulator(CountingScene(), port=again.port).start()
