"""Faults of replies and data frames from a client's side; afterwards the server works again."""

import math
import struct

import numpy as np
import pytest

from gateway.errors import FrameError
from gateway.rtc3d.frames import split_frame
from gateway.simulator.faults.base import Fault
from gateway.simulator.faults.frame_faults import (
    ConstantFrameNumbers,
    FrozenTimestamps,
    JumpingTimestamps,
    Occlusion,
    ShortEvents,
    UnknownComponent,
    WrongByteOrder,
    WrongCounts,
)
from gateway.simulator.faults.reply_faults import (
    DoubledAcknowledgements,
    FramesFirst,
    LateAcknowledgements,
    MinimalServer,
    MissingAcknowledgements,
    RefusedCommands,
    ReplyText,
)
from gateway.simulator.simulator import Simulator
from tests.integration.faulty import NEVER_MS, VERSION, clear_and_check, only_connection, playing
from tests.integration.raw_client import RawClient, consecutive, numbers
from tests.unit.rtc3d_server.wire import (
    COMMAND,
    DATA,
    ERROR,
    EVENT,
    MARKERS,
    NO_DATA,
    XML,
    WireComponent,
    command,
    components_in,
)

# Replies ------------------------------------------------------------------------------------


async def test_a_refused_command_gets_an_error_packet_and_is_not_executed() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(RefusedCommands(commands=("setbyteorder",)))
        packet_type, text = await client.ask("SetByteOrder LittleEndian")
        assert packet_type == ERROR
        assert text == b"Error-setbyteorder is refused"
        await client.ask("StreamFrames 3D")
        assert consecutive(await client.frames(3, "big"))
        await clear_and_check(simulator, client)


async def test_a_minimal_server_streams() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(MinimalServer())
        for text in ("Version 1.0", "SendParameters", "StreamFrames AllFrames", "StreamFrames 3D"):
            assert (await client.ask(text))[0] == ERROR
        assert await client.ask("StreamFrames FrequencyDivisor:2") == (
            COMMAND,
            b"OK-StreamFrames FrequencyDivisor:2",
        )
        assert np.diff(numbers(await client.frames(20))).tolist() == [2] * 19
        await clear_and_check(simulator, client)


async def test_acknowledgements_can_be_missing() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(MissingAcknowledgements(commands=("version", "sendcurrentframe")))
        client.send(command("Version 1.0"), command("SendCurrentFrame 3D"))
        [[component]] = await client.frames(1)
        assert component.type == MARKERS
        assert await client.ask("SetByteOrder BigEndian") == (COMMAND, b"OK-SetByteOrder BigEndian")
        assert (await client.ask("Fly"))[0] == ERROR
        await clear_and_check(simulator, client)


async def test_acknowledgements_can_be_doubled() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(DoubledAcknowledgements(copies=3))
        assert [await client.ask("Version 1.0"), await client.read(), await client.read()] == [VERSION] * 3
        assert (await client.ask("SendParameters"))[0] == XML
        assert (await client.ask("Fly"))[0] == ERROR
        await clear_and_check(simulator, client)


async def test_late_acknowledgements_are_overtaken_by_everything() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(LateAcknowledgements(delay_ms=NEVER_MS, times=2))
        client.send(command("Version 1.0"), command("StreamFrames 3D"), command("SendParameters General"))
        assert (await client.reply())[0] == XML
        await client.frames(10)
        assert simulator.faults.active_on(only_connection(simulator).number) == []

        await simulator.faults.clear()

        assert await client.reply() == VERSION
        assert await client.reply() == (COMMAND, b"OK-StreamFrames 3D")
        await clear_and_check(simulator, client)


async def test_late_acknowledgements_are_sent_after_their_delay() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(LateAcknowledgements(delay_ms=1))
        assert await client.ask("Version 1.0") == VERSION
        assert await client.ask("Version 1.0") == VERSION


async def test_frames_can_come_before_the_acknowledgement() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(FramesFirst(frames=3))
        client.send(command("StreamFrames 3D"))
        before = await client.frames(3)
        assert await client.read() == (COMMAND, b"OK-StreamFrames 3D")
        assert consecutive([*before, *await client.frames(10)])
        await clear_and_check(simulator, client)


async def test_without_frames_no_data_comes_before_the_acknowledgement() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(FramesFirst(frames=3))
        simulator.stop_measurement()
        assert await client.ask("StreamFrames 3D") == (NO_DATA, b"")
        assert await client.read() == (COMMAND, b"OK-StreamFrames 3D")
        assert await client.ask("StreamFrames Stop") == (COMMAND, b"OK-StreamFrames Stop")


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        (ReplyText(form="echo"), b"Version 1.0"),
        (ReplyText(form="ok-verb"), b"ok-version"),
    ],
)
async def test_replies_can_have_another_text(fault: Fault, text: bytes) -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(fault)
        assert await client.ask("Version 1.0") == (COMMAND, text)
        packet_type, error = await client.ask("Fly")
        assert packet_type == ERROR
        assert error.startswith(b"err-Unknown command")
        assert (await client.ask("SendParameters"))[0] == XML
        await simulator.faults.clear()
        client.send(command("Bye"))
        assert await client.rest() == struct.pack(">II", 11, COMMAND) + b"bye"


# Frames -------------------------------------------------------------------------------------


async def frames_with(
    simulator: Simulator, client: RawClient, fault: Fault, asked: str
) -> list[list[WireComponent]]:
    await client.ask(f"StreamFrames {asked}")
    await client.frames(5)
    simulator.faults.begin(fault)
    num_before = simulator.frames_sent - 5
    await client.frames(num_before)
    return await client.frames(20)


async def test_markers_and_tools_can_be_out_of_view() -> None:
    async with playing() as (simulator, client):
        for markers, tool, channels in await frames_with(simulator, client, Occlusion(), "3D 6D Analog"):
            assert all(all(map(math.isnan, item[:3])) and item[3] == 999.0 for item in markers.items)
            assert all(map(math.isnan, tool.items[0]))
            assert channels.items[0][0] == channels.frame_number - 1
        await clear_and_check(simulator, client)


async def test_time_stamps_can_freeze() -> None:
    async with playing() as (simulator, client):
        frames = await frames_with(simulator, client, FrozenTimestamps(), "3D")
        [(frozen, _)] = simulator.faults.active_on(only_connection(simulator).number)
        assert {component.timestamp_us for [component] in frames} == {frozen.timestamp_us}
        assert frozen.timestamp_us
        assert consecutive(frames)
        await clear_and_check(simulator, client)


async def test_time_stamps_can_jump() -> None:
    async with playing() as (simulator, client):
        frames = await frames_with(simulator, client, JumpingTimestamps(jump_ms=-7000), "3D")
        assert all(
            component.timestamp_us == (component.frame_number - 1) * 1000 - 7_000_000
            for [component] in frames
        )
        await clear_and_check(simulator, client)


async def test_frame_numbers_can_be_constant() -> None:
    async with playing() as (simulator, client):
        frames = await frames_with(simulator, client, ConstantFrameNumbers(frame_number=5), "3D")
        assert {component.frame_number for [component] in frames} == {5}
        assert np.diff([component.timestamp_us for [component] in frames]).tolist() == [1000] * 19
        await clear_and_check(simulator, client)


async def test_events_can_be_short() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(ShortEvents(times=2))
        await client.ask("StreamFrames Events")
        for event_bytes in (16, 16, 24):
            packet_type, body = await client.read()
            assert packet_type == DATA
            [component] = components_in(body, event_bytes=event_bytes)
            assert component.type == EVENT
        await clear_and_check(simulator, client)


async def test_a_byte_order_can_be_acknowledged_and_ignored() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(WrongByteOrder(byte_order="big"))
        assert await client.ask("SetByteOrder LittleEndian") == (COMMAND, b"OK-SetByteOrder LittleEndian")
        await client.ask("StreamFrames 3D Analog")
        assert consecutive(await client.frames(10, "big"))
        await simulator.faults.clear()
        client.send(command("StreamFrames Stop"))
        assert await client.reply() == (COMMAND, b"OK-StreamFrames Stop")
        await client.ask("StreamFrames 3D")
        assert consecutive(await client.frames(10, "little"))


async def test_frames_can_have_a_component_of_unknown_type() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(UnknownComponent(component_type=1234))
        await client.ask("StreamFrames 3D")
        _, body = await client.read()
        frame = split_frame(body, "big")
        assert frame.unknown_types == (1234,)
        assert len(frame.components) == 1
        await clear_and_check(simulator, client)


async def test_wrong_counts_affect_as_many_frames_as_times_says() -> None:
    async with playing() as (simulator, client):
        simulator.faults.begin(WrongCounts(times=3))
        await client.ask("StreamFrames 3D")
        for _ in range(3):
            packet_type, body = await client.read()
            assert packet_type == DATA
            with pytest.raises(FrameError):
                split_frame(body, "big")
        assert numbers(await client.frames(1))[0] >= 4
        await clear_and_check(simulator, client)
