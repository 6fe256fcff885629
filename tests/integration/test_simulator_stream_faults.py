"""Faults of the byte stream from a client's side; afterwards the server works again."""

import struct

import numpy as np
import pytest

from gateway.rtc3d_server.client_connection import ClientConnection
from gateway.simulator.faults.base import Fault
from gateway.simulator.faults.momentary_faults import Cut, Garbage, Oversize, Undersize
from gateway.simulator.faults.reply_faults import LateAcknowledgements
from gateway.simulator.faults.stream_faults import Delay, HalfOpen, Jitter, Merge, SlowReader, Split
from gateway.simulator.faults.write_queue import MAX_WAITING_BYTES
from gateway.simulator.simulator import Simulator
from tests.integration.faulty import (
    FAST_HZ,
    NEVER_MS,
    VERSION,
    clear_and_check,
    only_connection,
    playing,
    waiting_bytes,
)
from tests.integration.raw_client import connected, consecutive, numbers, until
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.unit.rtc3d_server.wire import COMMAND, DATA, ERROR, XML, command, components_in, packets_in


async def test_delayed_packets_keep_their_order() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(Delay(delay_ms=NEVER_MS))
        client.send(command("Version 1.0"), command("Fly"), command("StreamFrames 3D"))
        await until(lambda: simulator.frames_sent > 5)
        assert waiting_bytes(simulator) > 5 * 60
        assert only_connection(simulator).transport.get_write_buffer_size() == 0

        await simulator.faults.clear()

        assert await client.read() == VERSION
        assert (await client.read())[0] == ERROR
        assert await client.read() == (COMMAND, b"OK-StreamFrames 3D")
        assert consecutive(await client.frames(20))
        await clear_and_check(simulator, client)


async def test_a_short_delay_loses_nothing() -> None:
    async with playing() as (simulator, client):
        delay = simulator.faults.begin(Delay(delay_ms=5))
        await client.ask("StreamFrames 3D")
        assert consecutive(await client.frames(50))
        simulator.faults.end(delay)
        assert consecutive(await client.frames(50))
        await until(lambda: waiting_bytes(simulator) == 0)


async def test_jitter_split_and_merge_together_keep_all_packets_in_order() -> None:
    async with playing() as (simulator, client):
        faults = (Jitter(mean_ms=3), Split(pieces=5, pause_ms=0.1), Merge(window_ms=4), Delay(delay_ms=1))
        active_faults = [simulator.faults.begin(fault) for fault in faults]
        await client.ask("StreamFrames 3D")
        frames = await client.frames(200)
        assert consecutive(frames)
        assert all(fault.num_happened > 200 for fault in active_faults)
        await simulator.faults.clear()
        assert consecutive([*frames[-1:], *await client.frames(50)])
        await clear_and_check(simulator, client)


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


async def test_a_slow_reader_replies_late_and_continues_to_stream() -> None:
    async with playing() as (simulator, client):
        await client.ask("StreamFrames 3D")
        simulator.faults.begin(SlowReader(bytes_per_s=0.1))
        client.send(command("Version 1.0"))
        await until(lambda: waiting_bytes(simulator) == len(command("Version 1.0")))
        assert consecutive(await client.frames(only_connection(simulator).sent_counts.frames + 50))

        await simulator.faults.clear()

        assert await client.reply() == VERSION
        await clear_and_check(simulator, client)


async def test_a_slow_reader_reads_all_commands() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(SlowReader(bytes_per_s=2000))
        for _ in range(3):
            assert await client.ask("Version 1.0") == VERSION


async def test_garbage_is_sent_between_two_packets_and_is_the_same_for_the_same_seed() -> None:
    heard = []
    for seed in (1, 1, 2):
        async with playing() as (simulator, client):
            assert await client.ask("Version 1.0") == VERSION
            simulator.faults.play([], seed=seed)
            simulator.faults.begin(Garbage(num_bytes=20))
            heard.append(await client.exactly(20))
            assert await client.ask("Version 1.0") == VERSION
            await clear_and_check(simulator, client)
    assert heard[0] == heard[1] != heard[2]


@pytest.mark.parametrize(
    ("fault", "size"),
    [
        (Oversize(), 0xFFFFFFFF),
        (Oversize(size_bytes=20_000_000), 20_000_000),
        (Undersize(), 0),
        (Undersize(size_bytes=7), 7),
    ],
)
async def test_a_header_can_announce_a_wrong_size(fault: Fault, size: int) -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(fault)
        assert await client.exactly(8) == struct.pack(">II", size, DATA)
        await clear_and_check(simulator, client)


async def test_unexpected_bytes_are_sent_after_delayed_packets() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(Delay(delay_ms=NEVER_MS))
        client.send(command("Version 1.0"))
        await until(lambda: waiting_bytes(simulator) > 0)
        simulator.faults.begin(Undersize(size_bytes=3))
        await simulator.faults.clear()
        assert await client.read() == VERSION
        assert await client.exactly(8) == struct.pack(">II", 3, DATA)


async def test_the_number_of_waiting_bytes_is_limited(caplog: pytest.LogCaptureFixture) -> None:
    scene = CountingScene(FAST_HZ, num_markers=5000)
    async with Simulator(scene) as simulator, connected(simulator) as client:
        simulator.faults.begin(Delay(delay_ms=NEVER_MS))
        client.send(command("StreamFrames 3D"))
        await until(lambda: "dropping packets" in caplog.text)
        sent = simulator.frames_sent
        await until(lambda: simulator.frames_sent > sent + 50)
        assert MAX_WAITING_BYTES - 100_000 < waiting_bytes(simulator) <= MAX_WAITING_BYTES
        assert caplog.text.count("dropping packets") == 1


async def test_bye_is_answered_before_the_connection_ends_despite_any_delay() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(Delay(delay_ms=NEVER_MS))
        simulator.faults.begin(LateAcknowledgements(delay_ms=NEVER_MS))
        client.send(command("Version 1.0"), command("Bye"))
        assert packets_in(await client.rest()) == [VERSION, (COMMAND, b"bye")]
