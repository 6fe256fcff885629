"""The simulator from a client's side: hand-made packets over TCP."""

import asyncio
import logging
import struct
from collections import Counter
from dataclasses import replace

import pytest

from gateway.errors import GatewayError
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.rtc3d_server.client_connection import MAX_UNREAD_BYTES
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.integration.raw_client import TIMEOUT_S, connected, consecutive, until
from tests.integration.served import Served
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.unit.rtc3d_server.wire import (
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
FAST_HZ = 1000.0


# The protocol -------------------------------------------------------------------------------


async def test_a_client_can_follow_the_order_of_the_specification(served: Served) -> None:
    async with (
        Simulator(SyntheticScene(rate_hz=FAST_HZ)) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        assert await client.ask("Version 1.0\0") == (COMMAND, b"OK-Version 1.0")
        assert await client.ask("SetByteOrder BigEndian") == (COMMAND, b"OK-SetByteOrder BigEndian")
        packet_type, xml = await client.ask("SendParameters All")
        parameters = parse_parameters(xml).parameters
        assert packet_type == XML
        assert parameters.general is not None
        assert parameters.general.name == "RTC3D simulator"
        assert (parameters.general.address, parameters.general.port) == ("127.0.0.1", simulator.port)
        assert replace(parameters, general=None) == simulator.scene.parameters
        assert await client.ask("StreamFrames") == (COMMAND, b"OK-StreamFrames")
        for components in await client.frames(20):
            sizes = [(each.type, len(each.items)) for each in components if each.type != EVENT]
            assert sizes == [(MARKERS, 20), (TOOLS, 2), (ANALOG, 8), (FORCE, 2)]
        client.send(command("Bye"))
        assert packets_in(await client.rest())[-1] == (COMMAND, b"bye")


async def test_nothing_follows_bye() -> None:
    async with Simulator(CountingScene(FAST_HZ)) as simulator:
        for _ in range(10):
            async with connected(simulator) as client:
                await client.ask("StreamFrames Analog")
                await client.frames(5)
                client.send(command("Bye"), command("Version 1.0"))
                assert packets_in(await client.rest())[-1] == (COMMAND, b"bye")


async def test_commands_can_arrive_in_pieces_or_several_at_once(served: Served) -> None:
    async with (
        Simulator(CountingScene()) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        bunch = command("Version 1.0") + command("SetByteOrder LittleEndian") + command("Version 1.0")
        for byte in bunch:
            client.send(bytes([byte]))
            await client.writer.drain()
        client.send(bunch)

        replies = [(await client.read())[1] for _ in range(6)]

        assert replies == [b"OK-Version 1.0", b"OK-SetByteOrder LittleEndian", b"OK-Version 1.0"] * 2


async def test_a_client_that_closes_its_sending_half_gets_all_answers(served: Served) -> None:
    async with (
        Simulator(CountingScene()) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        client.send(command("Version 1.0") * 300, command("SendCurrentFrame 3D"), command("Fly"))
        client.writer.write_eof()
        packets = packets_in(await client.rest())
        kinds = [each[0] for each in packets]
        assert sorted(kinds) == [ERROR, *[COMMAND] * 301, DATA]


async def test_invalid_packets_get_an_error_packet_and_the_connection_stays_open(served: Served) -> None:
    """A client's mistake must not cost it the frames of its other requests."""
    async with (
        Simulator(CountingScene()) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        for bad in (
            *(command("Version 1.1"), command("Fly"), command(""), command("StreamFrames Frequency:fast")),
            *(packet(ERROR, b"Error"), packet(XML, b"<RT_Parameters/>"), packet(DATA, b"\0\0\0\1")),
            *(packet(NO_DATA), packet(5, b"c3d"), packet(77, b"?")),
        ):
            client.send(bad)
            packet_type, text = await client.read()
            assert packet_type == ERROR
            assert len(text) > len("Error-")
        assert await client.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")


@pytest.mark.parametrize("size", [7, 64 * 1024 + 1])
async def test_a_size_out_of_bounds_gets_an_error_packet_and_ends_the_connection(
    served: Served, size: int
) -> None:
    async with (
        Simulator(CountingScene()) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        client.send(command("Version 1.0"), struct.pack(">II", size, COMMAND))

        [reply, (packet_type, text)] = packets_in(await client.rest())

        assert reply == (COMMAND, b"OK-Version 1.0")
        assert packet_type == ERROR
        assert str(size).encode() in text


async def test_commands_are_logged_as_debug(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG", "gateway.rtc3d_server")
    async with Simulator(CountingScene()) as simulator, connected(simulator) as client:
        await client.ask("Version 1.0\0")
        await client.ask("x" * 1000)
        client.send(packet(DATA, b"\0\0\0\0"))
        await client.read()
    received = [
        record.message.split(" received ")[1] for record in caplog.records if " received " in record.message
    ]
    assert received == [r"'Version 1.0\x00'", repr("x" * 200), "a packet of type 3 with 4 bytes"]


async def test_each_packet_is_sent_with_one_send(served: Served) -> None:
    async with (
        Simulator(SyntheticScene(markers=50)) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        client.send(command("StreamFrames"), command("SendParameters"))
        num_packets = 0
        # The next packets arrive meanwhile, and TCP divides a few while this client is slow.
        while num_packets < 60 or client.segments_received() > 1.5 * num_packets:
            await client.read()
            num_packets += 1
            assert num_packets < 1000, "packets are sent in several parts"


# Many clients -------------------------------------------------------------------------------


async def test_a_client_that_does_not_read_delays_no_other_and_continues_when_it_reads(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.WARNING)
    scene = CountingScene(FAST_HZ, num_markers=5000)
    async with Simulator(scene) as simulator, connected(simulator) as silent:
        silent.writer.transport.pause_reading()  # type: ignore[attr-defined] # a StreamWriter's is a Transport
        silent.send(command("StreamFrames 3D Events"))
        await until(lambda: "does not read" in caplog.text)
        [full] = simulator.connections

        async with connected(simulator) as reading:
            await reading.ask("StreamFrames 6D")
            assert consecutive(await reading.frames(300))
        assert full.transport.get_write_buffer_size() < MAX_UNREAD_BYTES + 2**20
        assert simulator.frames_dropped > 100

        silent.writer.transport.resume_reading()  # type: ignore[attr-defined] # as above
        assert (await silent.read())[0] == COMMAND
        frames = await silent.frames(full.sent_counts.frames + 50)
        assert not consecutive(frames)
        events = [
            event[0]
            for components in frames
            for component in components
            if component.type == EVENT
            for event in component.items
        ]
        assert events == list(range(1, len(events) + 1))
        assert len(events) >= 4
        dropped = simulator.frames_dropped
    assert simulator.frames_dropped >= dropped
    assert caplog.text.count("does not read") == 1


async def test_a_client_can_disconnect_while_it_streams() -> None:
    async with Simulator(CountingScene(FAST_HZ)) as simulator:
        async with connected(simulator) as client:
            await client.ask("StreamFrames")
            await client.frames(3)
            client.writer.transport.abort()
        await until(lambda: not simulator.connections)
        async with connected(simulator) as client:
            await client.ask("StreamFrames 3D")
            assert consecutive(await client.frames(20))


# Statistics and life cycle ------------------------------------------------------------------


async def test_sent_frames_are_counted_for_each_client_and_in_total() -> None:
    async with Simulator(CountingScene(FAST_HZ)) as simulator:
        received: Counter[str] = Counter()
        num_frames = 0
        for sent in ("StreamFrames 3D Events", "StreamFrames All"):
            async with connected(simulator) as client:
                general = parse_parameters((await client.ask("SendParameters General"))[1]).parameters.general
                assert general is not None
                assert (general.frames_sent, general.frames_per_s) == (0, 0.0)
                await client.ask(sent)
                frames = await client.frames(150)
                client.send(command("StreamFrames Stop"), command("SendParameters General"))
                while (reply := await client.read())[0] != COMMAND:
                    frames.append(components_in(reply[1]))
                _, xml = await client.read()
                general = parse_parameters(xml).parameters.general
                assert general is not None
                assert general.frames_sent == len(frames)
                assert general.frames_per_s is not None
                assert general.frames_per_s > 0
                received.update(KEYS[component.type] for components in frames for component in components)
                num_frames += len(frames)

        assert simulator.components_sent == received
        assert simulator.frames_sent == num_frames


async def test_closing_sends_no_data_and_frees_the_port() -> None:
    simulator = Simulator(CountingScene(FAST_HZ))
    await simulator.start()
    async with connected(simulator) as client:
        await client.ask("StreamFrames 3D")
        await client.frames(1)
        await simulator.close()
        assert packets_in(await client.rest())[-1] == (NO_DATA, b"")
    async with Simulator(CountingScene(), port=simulator.port) as again, connected(again) as client:
        assert await client.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")


async def test_closing_does_not_wait_for_a_client_that_does_not_read(
    caplog: pytest.LogCaptureFixture,
) -> None:
    scene = CountingScene(FAST_HZ, num_markers=5000)
    async with Simulator(scene) as simulator, connected(simulator) as silent:
        silent.writer.transport.pause_reading()  # type: ignore[attr-defined] # a StreamWriter's is a Transport
        silent.send(command("StreamFrames"))
        await until(lambda: "does not read" in caplog.text)
        async with asyncio.timeout(TIMEOUT_S):
            await simulator.close()
        await until(lambda: not simulator.connections)


async def test_the_error_about_a_port_in_use_names_it() -> None:
    async with Simulator(CountingScene()) as simulator:
        with pytest.raises(GatewayError, match=f"127.0.0.1, port {simulator.port}: .*free"):
            await Simulator(CountingScene(), port=simulator.port).start()
