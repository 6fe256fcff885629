"""The simulator as its clients see it: bytes packed here by hand, over TCP, read as they come."""

import asyncio
import logging
import os
import socket
import struct
import sys
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import ezc3d
import numpy as np
import pytest

from gateway.errors import GatewayError
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.simulator.scene import Scene
from gateway.simulator.server import MAX_UNREAD_BYTES, Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.simulator.take import Take
from tests.unit.simulator.counting_scene import CountingScene
from tests.unit.simulator.wire import (
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
    ByteOrder,
    Part,
    command,
    cut,
    frame_of,
    packet,
)

TIMEOUT_S = 20.0
KEYS = {MARKERS: "3d", TOOLS: "6d", ANALOG: "analog", FORCE: "force", EVENT: "event"}
FAST_HZ = 1000.0


class RawClient:
    """A client made of nothing but a socket."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer

    def send(self, *packets: bytes) -> None:
        self.writer.write(b"".join(packets))

    async def read(self) -> tuple[int, bytes]:
        """The next packet's type and body."""
        async with asyncio.timeout(TIMEOUT_S):
            size, packet_type = struct.unpack(">II", await self.reader.readexactly(8))
            return packet_type, await self.reader.readexactly(size - 8)

    async def ask(self, text: str) -> tuple[int, bytes]:
        self.send(command(text))
        return await self.read()

    async def frames(self, count: int, byte_order: ByteOrder = "big") -> list[list[Part]]:
        frames = []
        for _ in range(count):
            packet_type, body = await self.read()
            assert packet_type == DATA
            frames.append(frame_of(body, byte_order))
        return frames

    async def rest(self) -> bytes:
        """What still comes until the server closes the connection."""
        async with asyncio.timeout(TIMEOUT_S):
            return await self.reader.read()


@asynccontextmanager
async def connected(simulator: Simulator) -> AsyncIterator[RawClient]:
    reader, writer = await asyncio.open_connection("127.0.0.1", simulator.port)
    try:
        yield RawClient(reader, writer)
    finally:
        writer.close()


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(TIMEOUT_S):
        while not condition():  # noqa: ASYNC110 - what is waited for here has no event
            await asyncio.sleep(0.005)


def numbers(frames: list[list[Part]]) -> list[int]:
    return [frame[0].frame_number for frame in frames]


def consecutive(frames: list[list[Part]]) -> bool:
    first = frames[0][0].frame_number
    return numbers(frames) == list(range(first, first + len(frames)))


# The protocol -------------------------------------------------------------------------------


async def test_a_client_that_does_all_in_the_order_of_the_specification() -> None:
    async with Simulator(SyntheticScene(rate_hz=FAST_HZ)) as simulator, connected(simulator) as client:
        assert await client.ask("Version 1.0\0") == (COMMAND, b"OK-Version 1.0")
        assert await client.ask("SetByteOrder BigEndian") == (COMMAND, b"OK-SetByteOrder BigEndian")
        packet_type, xml = await client.ask("SendParameters All")
        parameters = parse_parameters(xml).parameters
        assert packet_type == XML
        assert parameters.general is not None
        assert parameters.general.name == "RTC3D simulator"
        assert (parameters.general.address, parameters.general.port) == ("127.0.0.1", simulator.port)
        assert parameters.markers == simulator.scene.parameters.markers
        assert parameters.tools == simulator.scene.parameters.tools
        assert parameters.analog == simulator.scene.parameters.analog
        assert parameters.force == simulator.scene.parameters.force
        assert parameters.events == simulator.scene.parameters.events
        assert await client.ask("StreamFrames") == (COMMAND, b"OK-StreamFrames")
        for parts in await client.frames(20):
            assert [part.type for part in parts if part.type != EVENT] == [MARKERS, TOOLS, ANALOG, FORCE]
            assert [len(part.items) for part in parts if part.type != EVENT] == [20, 2, 8, 2]
        client.send(command("Bye"))
        assert cut(await client.rest())[-1] == (COMMAND, b"bye")


async def test_ndis_client_asks_for_little_endian_first_and_for_events_in_the_current_frame() -> None:
    scene = CountingScene()
    async with Simulator(scene) as simulator, connected(simulator) as client:
        assert await client.ask("SetByteOrder LittleEndian") == (COMMAND, b"OK-SetByteOrder LittleEndian")
        sent = "SendCurrentFrame 3D 6D Analog Force Events "
        for _ in range(10):
            assert await client.ask(sent) == (COMMAND, b"OK-SendCurrentFrame 3D 6D Analog Force Events")
            [parts] = await client.frames(1, "little")
            assert [part.type for part in parts][:3] == [MARKERS, TOOLS, ANALOG]
            assert parts[0].items[0][0] == parts[0].frame_number - 1
        client.send(command("Bye"))
        assert await client.rest() == packet(COMMAND, b"bye")


async def test_nothing_follows_bye() -> None:
    async with Simulator(CountingScene(FAST_HZ)) as simulator:
        for _ in range(10):
            async with connected(simulator) as client:
                await client.ask("StreamFrames Analog")
                await client.frames(5)
                client.send(command("Bye"), command("Version 1.0"))
                assert cut(await client.rest())[-1] == (COMMAND, b"bye")


@pytest.mark.parametrize("ending", ["", "\0", "\n", "\r\n", " \n\0"])
@pytest.mark.parametrize("words", ["streamframes allframes analog", "STREAMFRAMES ALLFRAMES ANALOG "])
async def test_commands_end_in_anything_and_in_any_case(words: str, ending: str) -> None:
    async with Simulator(CountingScene()) as simulator, connected(simulator) as client:
        assert await client.ask(words + ending) == (COMMAND, f"OK-{words.strip()}".encode())
        frames = await client.frames(30)
        assert {part.type for frame in frames for part in frame} == {ANALOG}
        assert consecutive(frames)


async def test_commands_come_in_pieces_and_in_bunches() -> None:
    async with Simulator(CountingScene()) as simulator, connected(simulator) as client:
        bunch = command("Version 1.0") + command("SetByteOrder LittleEndian") + command("Version 1.0")
        for byte in bunch:
            client.send(bytes([byte]))
            await client.writer.drain()
        client.send(bunch)

        replies = [(await client.read())[1] for _ in range(6)]

        assert replies == [b"OK-Version 1.0", b"OK-SetByteOrder LittleEndian", b"OK-Version 1.0"] * 2


@pytest.mark.parametrize(
    "bad",
    [
        command("Version 1.1"),
        command("Fly"),
        command(""),
        command("StreamFrames Frequency:fast"),
        packet(ERROR, b"Error"),
        packet(XML, b"<RT_Parameters/>"),
        packet(DATA, b"\0\0\0\1"),
        packet(NO_DATA),
        packet(5, b"c3d"),
        packet(77, b"?"),
    ],
)
async def test_what_is_refused_gets_an_error_packet_and_the_connection_lives_on(bad: bytes) -> None:
    async with Simulator(CountingScene()) as simulator, connected(simulator) as client:
        client.send(bad)
        packet_type, text = await client.read()
        assert packet_type == ERROR
        assert len(text) > len("Error-")
        assert await client.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")


@pytest.mark.parametrize("size", [0, 7, 64 * 1024 + 1, 0xFFFFFFFF])
async def test_a_size_out_of_bounds_gets_an_error_packet_after_the_other_replies_and_the_end(
    size: int,
) -> None:
    async with Simulator(CountingScene()) as simulator, connected(simulator) as client:
        client.send(command("Version 1.0"), struct.pack(">II", size, COMMAND))

        [reply, (packet_type, text)] = cut(await client.rest())

        assert reply == (COMMAND, b"OK-Version 1.0")
        assert packet_type == ERROR
        assert str(size).encode() in text


async def test_a_recording_is_switched_on_without_a_reply() -> None:
    event = struct.pack(">IIIiqI", 1, 48, EVENT, -1, 0, 1) + struct.pack(">iqiii", 1, 0, -1, -1, -1)
    async with Simulator(CountingScene()) as simulator, connected(simulator) as client:
        client.send(packet(DATA, event))
        assert await client.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")
        [connection] = simulator.connections
        assert connection.client.recording


async def test_each_packet_is_sent_with_one_send() -> None:
    async with Simulator(SyntheticScene(markers=50)) as simulator, connected(simulator) as client:
        client.send(command("StreamFrames"), command("SendParameters"))
        for _ in range(60):
            await client.read()
        assert segments_received(client) <= 60


def segments_received(client: RawClient) -> int:
    """How many TCP segments with data came; at least one for each send, as Nagle is off."""
    data_segs_in = 152  # in struct tcp_info of linux/tcp.h
    info = client.writer.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256)
    return int.from_bytes(info[data_segs_in : data_segs_in + 4], sys.byteorder)


# Rates, by frame numbers alone --------------------------------------------------------------


@pytest.mark.parametrize(
    ("sent", "gaps"),
    [
        ("StreamFrames AllFrames 3D", [1] * 59),
        ("StreamFrames 3D Analog", [1] * 59),
        ("StreamFrames FrequencyDivisor:7 3D", [7] * 59),
        ("StreamFrames Frequency:600 3D", [2, 2, 1] * 19 + [2, 2]),
        ("StreamFrames Frequency:1000 3D", [1] * 59),
        ("StreamFrames Frequency:5000 3D", [1] * 59),
        ("StreamFrames Frequency:250 Analog", [40] * 59),
    ],
)
async def test_the_rate_asked_for_is_the_rate_sent(sent: str, gaps: list[int]) -> None:
    async with Simulator(CountingScene(FAST_HZ)) as simulator, connected(simulator) as client:
        await client.ask(sent)
        frames = await client.frames(60)

    assert np.diff(numbers(frames)).tolist() == gaps


async def test_time_stamps_are_those_of_the_measurement_and_equal_within_a_frame() -> None:
    async with Simulator(CountingScene(FAST_HZ)) as simulator, connected(simulator) as client:
        await client.ask("StreamFrames FrequencyDivisor:3 All")
        for parts in await client.frames(100):
            measured = [part for part in parts if part.type != EVENT]
            assert {part.timestamp_us for part in parts} == {(parts[0].frame_number - 1) * 1000}
            per_frame = {MARKERS: 1, TOOLS: 1, ANALOG: 10}
            for part in measured:
                assert part.frame_number - 1 == (parts[0].frame_number - 1) * per_frame[part.type]
                assert part.items[0][0] == part.frame_number - 1


async def test_clients_have_rates_and_byte_orders_of_their_own() -> None:
    async with (
        Simulator(CountingScene(FAST_HZ)) as simulator,
        connected(simulator) as big,
        connected(simulator) as little,
    ):
        await little.ask("SetByteOrder LittleEndian")
        await big.ask("StreamFrames 3D")
        await little.ask("StreamFrames FrequencyDivisor:2 6D")

        big_frames, little_frames = await asyncio.gather(big.frames(50), little.frames(50, "little"))

    assert {part.type for frame in big_frames for part in frame} == {MARKERS}
    assert {part.type for frame in little_frames for part in frame} == {TOOLS}
    assert np.diff(numbers(big_frames)).tolist() == [1] * 49
    assert np.diff(numbers(little_frames)).tolist() == [2] * 49


async def test_no_event_is_lost_at_a_low_rate() -> None:
    async with Simulator(CountingScene(FAST_HZ)) as simulator, connected(simulator) as client:
        await client.ask("StreamFrames FrequencyDivisor:50 3D Events")
        frames = await client.frames(10)

    events = [event[0] for parts in frames for part in parts if part.type == EVENT for event in part.items]
    assert len(events) >= 5
    assert np.diff(events).tolist() == [1.0] * (len(events) - 1)


async def test_events_can_be_sent_in_16_bytes() -> None:
    async with Simulator(CountingScene(), event_bytes=16) as simulator, connected(simulator) as client:
        await client.ask("StreamFrames Events")
        _, body = await client.read()

    [part] = frame_of(body, event_bytes=16)
    assert part.items == [(part.timestamp_us // 70_000, -1, -1, -1)]


# Measurements -------------------------------------------------------------------------------


async def test_the_end_and_the_start_of_a_measurement_reach_a_streaming_client() -> None:
    async with Simulator(CountingScene(FAST_HZ)) as simulator, connected(simulator) as client:
        await client.ask("StreamFrames 3D")
        await client.frames(5)
        simulator.stop_measurement()
        replies = [await client.read()]
        while replies[-1][0] == DATA:
            replies.append(await client.read())
        assert replies[-1] == (NO_DATA, b"")

        simulator.start_measurement()
        assert numbers(await client.frames(5)) == [1, 2, 3, 4, 5]


async def test_without_a_measurement_there_is_no_data_and_everything_else_works() -> None:
    async with Simulator(CountingScene()) as simulator, connected(simulator) as client:
        simulator.stop_measurement()

        assert await client.ask("SendCurrentFrame") == (COMMAND, b"OK-SendCurrentFrame")
        assert await client.read() == (NO_DATA, b"")
        assert await client.ask("StreamFrames") == (COMMAND, b"OK-StreamFrames")
        assert await client.read() == (NO_DATA, b"")
        assert (await client.ask("SendParameters"))[0] == XML
        assert await client.ask("StreamFrames Stop") == (COMMAND, b"OK-StreamFrames Stop")
        simulator.start_measurement()
        assert await client.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")


async def test_each_current_frame_is_newer_than_the_one_before() -> None:
    async with Simulator(CountingScene()) as simulator, connected(simulator) as client:
        client.send(command("SendCurrentFrame 3D"))
        frames = []
        for _ in range(10):
            assert await client.read() == (COMMAND, b"OK-SendCurrentFrame 3D")
            frames += await client.frames(1)
            client.send(command("SendCurrentFrame 3D"))

    assert np.all(np.diff(numbers(frames)) >= 1)


async def test_a_waiting_current_frame_ends_with_the_measurement() -> None:
    async with Simulator(CountingScene(rate_hz=0.001)) as simulator, connected(simulator) as client:
        await client.ask("SendCurrentFrame 3D")
        assert numbers(await client.frames(1)) == [1]
        assert await client.ask("SendCurrentFrame 3D") == (COMMAND, b"OK-SendCurrentFrame 3D")
        simulator.stop_measurement()
        assert await client.read() == (NO_DATA, b"")


async def test_once_plays_the_scene_from_the_first_request_to_its_end() -> None:
    scene = CountingScene(FAST_HZ, num_frames=80)
    async with Simulator(scene, once=True) as simulator, connected(simulator) as client:
        assert await client.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")
        await client.ask("StreamFrames Analog")
        frames = await client.frames(800)
        assert numbers(frames) == list(range(1, 801))
        assert await client.read() == (NO_DATA, b"")
        assert await client.ask("SendCurrentFrame") == (COMMAND, b"OK-SendCurrentFrame")
        assert await client.read() == (NO_DATA, b"")


# Many clients -------------------------------------------------------------------------------


async def test_64_clients_get_every_frame() -> None:
    async def play(simulator: Simulator, number: int) -> list[list[Part]]:
        async with connected(simulator) as client:
            byte_order: ByteOrder = "little" if number % 2 else "big"
            await client.ask(f"SetByteOrder {byte_order}Endian")
            await client.ask("StreamFrames All")
            return await client.frames(40, byte_order)

    async with Simulator(CountingScene()) as simulator:
        streams = await asyncio.gather(*(play(simulator, number) for number in range(64)))

    assert all(consecutive(frames) for frames in streams)
    assert simulator.frames_sent >= 64 * 40


async def test_a_client_that_does_not_read_delays_nobody_and_goes_on_when_it_reads(
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
        frames = await silent.frames(full.counts.frames + 50)
        assert not consecutive(frames)
        events = [
            event[0] for parts in frames for part in parts if part.type == EVENT for event in part.items
        ]
        assert events == list(range(1, len(events) + 1))
        assert len(events) >= 4
        dropped = simulator.frames_dropped
    assert simulator.frames_dropped >= dropped
    assert caplog.text.count("does not read") == 1


async def test_a_client_that_goes_away_in_mid_stream_is_forgotten() -> None:
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


async def test_what_was_sent_is_counted_for_each_client_and_in_all() -> None:
    async with Simulator(CountingScene(FAST_HZ)) as simulator:
        received: Counter[str] = Counter()
        num_frames = 0
        for sent in ("StreamFrames 3D Events", "StreamFrames All"):
            async with connected(simulator) as client:
                await client.ask(sent)
                frames = await client.frames(150)
                client.send(command("StreamFrames Stop"), command("SendParameters General"))
                while (reply := await client.read())[0] != COMMAND:
                    frames.append(frame_of(reply[1]))
                _, xml = await client.read()
                general = parse_parameters(xml).parameters.general
                assert general is not None
                assert general.frames_sent == len(frames)
                assert general.frames_per_s is not None
                assert general.frames_per_s > 0
                received.update(KEYS[part.type] for parts in frames for part in parts)
                num_frames += len(frames)

        assert simulator.sent == received
        assert simulator.frames_sent == num_frames


async def test_before_its_first_frame_a_clients_statistics_are_zero() -> None:
    async with Simulator(CountingScene()) as simulator, connected(simulator) as client:
        general = parse_parameters((await client.ask("SendParameters General"))[1]).parameters.general

    assert general is not None
    assert (general.frames_sent, general.frames_per_s) == (0, 0.0)


async def test_closing_takes_leave_of_the_clients_and_frees_the_port() -> None:
    simulator = Simulator(CountingScene(FAST_HZ))
    await simulator.start()
    async with connected(simulator) as client:
        await client.ask("StreamFrames 3D")
        await client.frames(1)
        await simulator.close()
        assert cut(await client.rest())[-1] == (NO_DATA, b"")
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


async def test_a_port_in_use_is_an_error_that_names_it() -> None:
    async with Simulator(CountingScene()) as simulator:
        with pytest.raises(GatewayError, match=f"127.0.0.1, port {simulator.port}: .*free"):
            await Simulator(CountingScene(), port=simulator.port).start()


# Real recordings ----------------------------------------------------------------------------


async def played_once(scene: Scene, components: str) -> dict[int, list[Part]]:
    """All that one pass of the scene sends, by component type."""
    parts: dict[int, list[Part]] = {}
    async with Simulator(scene, once=True) as simulator, connected(simulator) as client:
        await client.ask(f"StreamFrames {components}")
        while (reply := await client.read())[0] == DATA:
            for part in frame_of(reply[1]):
                parts.setdefault(part.type, []).append(part)
    return parts


@pytest.mark.takes
@pytest.mark.parametrize("name", ["qualisys.c3d", "optotrak.c3d"])
async def test_a_real_recording_arrives_as_ezc3d_reads_it(name: str) -> None:
    folder = os.environ.get("RTC3D_TAKES")
    if not folder:
        pytest.skip("RTC3D_TAKES names no folder with recordings")
    path = Path(folder) / name
    read = ezc3d.c3d(str(path), extract_forceplat_data=True)["data"]
    takes: list[Awaitable[dict[int, list[Part]]]] = [
        played_once(Take(path), components) for components in ("3D", "Analog Force")
    ]
    points, fast = await asyncio.gather(*takes)

    markers = np.array([part.items for part in points[MARKERS]], np.float32)
    missing = np.isnan(read["points"][:3]).any(axis=0).T
    assert markers.shape == (read["points"].shape[2], read["points"].shape[1], 4)
    assert np.array_equal(markers[..., :3][~missing], read["points"][:3].T[~missing].astype(np.float32))
    assert np.isnan(markers[missing, :3]).all()
    assert (markers[missing, 3] == 999.0).all()
    if read["analogs"].size:
        analog = np.array([part.items for part in fast[ANALOG]], np.float32)[..., 0]
        assert np.array_equal(analog, read["analogs"][0].T.astype(np.float32))
    for number, plate in enumerate(read["platform"]):
        force = np.array([part.items[number] for part in fast[FORCE]], np.float32)
        assert np.array_equal(force, np.concatenate([plate["force"], plate["moment"]]).T.astype(np.float32))
