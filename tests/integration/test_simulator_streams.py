"""The simulator's streams, checked by frame numbers and values, without timing."""

import asyncio

import numpy as np
import pytest

from gateway.simulator.simulator import Simulator
from tests.integration.raw_client import connected, numbers
from tests.integration.served import Served
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.unit.rtc3d_server.wire import (
    COMMAND,
    EVENT,
    MARKERS,
    NO_DATA,
    TOOLS,
    XML,
    command,
)

FAST_HZ = 1000.0


# Rates, by frame numbers alone --------------------------------------------------------------


@pytest.mark.parametrize(
    ("sent", "gaps"),
    [
        ("StreamFrames 3D Analog", [1] * 59),
        ("StreamFrames FrequencyDivisor:7 3D", [7] * 59),
        ("StreamFrames Frequency:600 3D", [2, 2, 1] * 19 + [2, 2]),
    ],
)
async def test_frames_are_sent_at_the_requested_rate(served: Served, sent: str, gaps: list[int]) -> None:
    """Directly and through a gateway, a client gets exactly the frames of its rate."""
    async with (
        Simulator(CountingScene(FAST_HZ)) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        await client.ask(sent)
        frames = await client.frames(60)

    assert np.diff(numbers(frames)).tolist() == gaps


async def test_time_stamps_are_equal_within_a_frame_and_no_event_is_lost_at_a_low_rate(
    served: Served,
) -> None:
    """Each component has the sample of the frame's time; events wait for the next frame."""
    async with (
        Simulator(CountingScene(FAST_HZ)) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        await client.ask("StreamFrames FrequencyDivisor:50 3D 6D Events")
        frames = await client.frames(10)

    events = []
    for components in frames:
        number = components[0].frame_number - 1
        assert {component.timestamp_us for component in components} == {number * 1000}
        for component in components:
            if component.type == EVENT:
                events += [event[0] for event in component.items]
            else:
                assert component.items[0][0] == component.frame_number - 1
                assert component.frame_number - 1 == number
    assert len(events) >= 5
    assert np.diff(events).tolist() == [1.0] * (len(events) - 1)


async def test_each_client_has_its_own_rate_and_byte_order(served: Served) -> None:
    async with (
        Simulator(CountingScene(FAST_HZ)) as simulator,
        served(simulator) as server,
        connected(server) as big,
        connected(server) as little,
    ):
        await little.ask("SetByteOrder LittleEndian")
        await big.ask("StreamFrames 3D")
        await little.ask("StreamFrames FrequencyDivisor:2 6D")

        big_frames, little_frames = await asyncio.gather(big.frames(50), little.frames(50, "little"))

    assert {component.type for frame in big_frames for component in frame} == {MARKERS}
    assert {component.type for frame in little_frames for component in frame} == {TOOLS}
    assert np.diff(numbers(big_frames)).tolist() == [1] * 49
    assert np.diff(numbers(little_frames)).tolist() == [2] * 49


# Measurements -------------------------------------------------------------------------------


async def test_the_end_and_the_start_of_a_measurement_reach_a_client(served: Served) -> None:
    """No Data ends a stream and answers requests (§5.3.4, §5.3.5); frames then begin with the first one."""
    async with (
        Simulator(CountingScene(FAST_HZ)) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        await client.ask("StreamFrames 3D")
        await client.frames(5)
        simulator.stop_measurement()
        assert await client.reply() == (NO_DATA, b"")
        assert await client.ask("SendCurrentFrame") == (COMMAND, b"OK-SendCurrentFrame")
        assert await client.read() == (NO_DATA, b"")
        assert (await client.ask("SendParameters"))[0] == XML

        simulator.start_measurement()
        assert numbers(await client.frames(5)) == [1, 2, 3, 4, 5]


async def test_each_current_frame_is_newer_than_the_one_before(served: Served) -> None:
    async with (
        Simulator(CountingScene()) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        client.send(command("SendCurrentFrame 3D"))
        frames = []
        for _ in range(10):
            assert await client.read() == (COMMAND, b"OK-SendCurrentFrame 3D")
            frames += await client.frames(1)
            client.send(command("SendCurrentFrame 3D"))

    assert np.all(np.diff(numbers(frames)) >= 1)


async def test_once_all_connections_get_the_scene_from_its_first_frame_to_its_end() -> None:
    """A gateway has several connections, and plays a recording exactly once."""
    scene = CountingScene(FAST_HZ, num_frames=80)
    async with (
        Simulator(scene, once=True) as simulator,
        connected(simulator) as first,
        connected(simulator) as second,
    ):
        assert await first.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")
        await first.ask("StreamFrames Analog")
        await second.ask("StreamFrames 3D")
        assert numbers(await first.frames(800)) == list(range(1, 801))
        assert numbers(await second.frames(80)) == list(range(1, 81))
        assert await first.read() == (NO_DATA, b"")
        assert await first.ask("SendCurrentFrame") == (COMMAND, b"OK-SendCurrentFrame")
        assert await first.read() == (NO_DATA, b"")
