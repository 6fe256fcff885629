"""The simulator's streams, checked by frame numbers and values, without timing."""

import asyncio
import os
from collections.abc import Awaitable
from pathlib import Path

import ezc3d
import numpy as np
import pytest

from gateway.rtc3d_server.scene import Scene
from gateway.simulator.c3d_scene import C3dScene
from gateway.simulator.simulator import Simulator
from tests.integration.raw_client import connected, numbers
from tests.integration.served import Served
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.unit.rtc3d_server.wire import (
    ANALOG,
    COMMAND,
    DATA,
    EVENT,
    FORCE,
    MARKERS,
    NO_DATA,
    TOOLS,
    XML,
    WireComponent,
    command,
    components_in,
)

FAST_HZ = 1000.0


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
async def test_frames_are_sent_at_the_requested_rate(served: Served, sent: str, gaps: list[int]) -> None:
    async with (
        Simulator(CountingScene(FAST_HZ)) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        await client.ask(sent)
        frames = await client.frames(60)

    assert np.diff(numbers(frames)).tolist() == gaps


async def test_time_stamps_are_those_of_the_measurement_and_equal_within_a_frame(served: Served) -> None:
    async with (
        Simulator(CountingScene()) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        await client.ask("StreamFrames FrequencyDivisor:3 All")
        for components in await client.frames(30):
            measured = [component for component in components if component.type != EVENT]
            assert {component.timestamp_us for component in components} == {
                (components[0].frame_number - 1) * 10_000
            }
            per_frame = {MARKERS: 1, TOOLS: 1, ANALOG: 10}
            for component in measured:
                assert (
                    component.frame_number - 1 == (components[0].frame_number - 1) * per_frame[component.type]
                )
                assert component.items[0][0] == component.frame_number - 1


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


async def test_no_event_is_lost_at_a_low_rate(served: Served) -> None:
    async with (
        Simulator(CountingScene(FAST_HZ)) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        await client.ask("StreamFrames FrequencyDivisor:50 3D Events")
        frames = await client.frames(10)

    events = [
        event[0]
        for components in frames
        for component in components
        if component.type == EVENT
        for event in component.items
    ]
    assert len(events) >= 5
    assert np.diff(events).tolist() == [1.0] * (len(events) - 1)


async def test_events_can_be_sent_in_16_bytes(served: Served) -> None:
    async with (
        Simulator(CountingScene(), event_bytes=16) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        await client.ask("StreamFrames Events")
        _, body = await client.read()

    [component] = components_in(body, event_bytes=16)
    assert component.items == [(component.timestamp_us // 70_000, -1, -1, -1)]


# Measurements -------------------------------------------------------------------------------


async def test_the_end_and_the_start_of_a_measurement_reach_a_streaming_client(served: Served) -> None:
    async with (
        Simulator(CountingScene(FAST_HZ)) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        await client.ask("StreamFrames 3D")
        await client.frames(5)
        simulator.stop_measurement()
        replies = [await client.read()]
        while replies[-1][0] == DATA:
            replies.append(await client.read())
        assert replies[-1] == (NO_DATA, b"")

        simulator.start_measurement()
        assert numbers(await client.frames(5)) == [1, 2, 3, 4, 5]


async def test_without_a_measurement_clients_get_no_data_and_everything_else_works(served: Served) -> None:
    async with (
        Simulator(CountingScene()) as simulator,
        served(simulator) as server,
        connected(server) as client,
    ):
        simulator.stop_measurement()

        assert await client.ask("SendCurrentFrame") == (COMMAND, b"OK-SendCurrentFrame")
        assert await client.read() == (NO_DATA, b"")
        assert await client.ask("StreamFrames") == (COMMAND, b"OK-StreamFrames")
        assert await client.read() == (NO_DATA, b"")
        assert (await client.ask("SendParameters"))[0] == XML
        assert await client.ask("StreamFrames Stop") == (COMMAND, b"OK-StreamFrames Stop")
        simulator.start_measurement()
        assert await client.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")


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


async def test_a_pending_request_for_the_current_frame_ends_with_the_measurement() -> None:
    async with (
        Simulator(CountingScene(rate_hz=0.001)) as simulator,
        connected(simulator) as client,
    ):
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


async def test_once_a_second_connection_gets_the_first_frames_too() -> None:
    scene = CountingScene(FAST_HZ, num_frames=80)
    async with (
        Simulator(scene, once=True) as simulator,
        connected(simulator) as first,
        connected(simulator) as second,
    ):
        await first.ask("StreamFrames Analog")
        await second.ask("StreamFrames 3D")
        assert numbers(await first.frames(800)) == list(range(1, 801))
        assert numbers(await second.frames(80)) == list(range(1, 81))


# Real recordings ----------------------------------------------------------------------------


async def played_once(scene: Scene, components: str) -> dict[int, list[WireComponent]]:
    """Return all components that one pass of the scene sends, by component type."""
    by_type: dict[int, list[WireComponent]] = {}
    async with Simulator(scene, once=True) as simulator, connected(simulator) as client:
        await client.ask(f"StreamFrames {components}")
        while (reply := await client.read())[0] == DATA:
            for component in components_in(reply[1]):
                by_type.setdefault(component.type, []).append(component)
    return by_type


@pytest.mark.takes
@pytest.mark.parametrize("name", ["qualisys.c3d", "optotrak.c3d"])
async def test_a_real_recording_arrives_as_ezc3d_reads_it(name: str) -> None:
    folder = os.environ.get("RTC3D_TAKES")
    if not folder:
        pytest.skip("RTC3D_TAKES names no folder with recordings")
    path = Path(folder) / name
    read = ezc3d.c3d(str(path), extract_forceplat_data=True)["data"]
    takes: list[Awaitable[dict[int, list[WireComponent]]]] = [
        played_once(C3dScene(path), components) for components in ("3D", "Analog Force")
    ]
    points, fast = await asyncio.gather(*takes)

    markers = np.array([component.items for component in points[MARKERS]], np.float32)
    missing = np.isnan(read["points"][:3]).any(axis=0).T
    assert markers.shape == (read["points"].shape[2], read["points"].shape[1], 4)
    assert np.array_equal(markers[..., :3][~missing], read["points"][:3].T[~missing].astype(np.float32))
    assert np.isnan(markers[missing, :3]).all()
    assert (markers[missing, 3] == 999.0).all()
    if read["analogs"].size:
        analog = np.array([component.items for component in fast[ANALOG]], np.float32)[..., 0]
        assert np.array_equal(analog, read["analogs"][0].T.astype(np.float32))
    for number, plate in enumerate(read["platform"]):
        force = np.array([component.items[number] for component in fast[FORCE]], np.float32)
        assert np.array_equal(force, np.concatenate([plate["force"], plate["moment"]]).T.astype(np.float32))
