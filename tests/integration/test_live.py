"""Live data in Python, through a gateway on real Zenoh and LCM."""

import asyncio
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gateway.client import Frame, live
from gateway.client.client import GatewayAddress, GatewayClient
from gateway.client.reception import Messages
from gateway.outputs.takes.settings import TakesSettings
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.takes import Take, open_take
from tests.support.networks import free_endpoint, lcm_url
from tests.support.queried_gateway import run_gateway, wait_until_cached
from tests.support.waiting import wait_until, wait_until_async

pytestmark = pytest.mark.netns


@pytest.fixture(params=["zenoh", "lcm"])
def where(request: pytest.FixtureRequest) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """The options of a gateway, and those of ``live`` to receive from it."""
    if request.param == "zenoh":
        endpoint = free_endpoint()
        yield {"listen": endpoint}, {"connect": endpoint}
    else:
        url = lcm_url()
        yield {"lcm_url": url}, {"url": url}


def receive(folder: Path, options: dict[str, Any]) -> tuple[list[Frame], list[Frame], Take, Take]:
    """Return frames, joined frames, and what was collected while the gateway recorded a take, and that."""
    with live("lab", **options) as data:
        frames = [frame for frame, _ in zip(data, range(200), strict=False)]
        started = data.client.start_take("walk", source="lab").received["lab"]
        collected = data.collect(1.0)
        data.client.stop_take(source="lab")
        newest = data.latest("3d", max_age_s=60)
        assert newest is not None
        assert newest.capture_utime >= frames[-1].capture_utime
        assert data.sources == ["lab"]
        assert data.num_dropped == 0
        assert started
    with live("lab", components=["3d", "analog"], join=True, **options) as data:
        joined = [frame for frame, _ in zip(data, range(20), strict=False)]
    [path] = folder.glob("**/walk*.lcmlog")
    return frames, joined, collected, open_take(path)


async def test_live_data_are_those_of_the_take_that_the_gateway_records(
    where: tuple[dict[str, Any], dict[str, Any]], tmp_path: Path
) -> None:
    """Bit for bit, with labels and units, on Zenoh as on LCM."""
    gateway_options, options = where
    takes = TakesSettings(enabled=True, directory=str(tmp_path))
    async with (
        Simulator(SyntheticScene(markers=5, tools=1, analog=3, plates=1)) as simulator,
        run_gateway(
            simulator.port, takes=takes, spool=tmp_path / "spool", remote_control=True, **gateway_options
        ) as gateway,
    ):
        await wait_until_cached(gateway)
        frames, joined, collected, take = await asyncio.to_thread(receive, tmp_path, options)
    assert {frame.key for frame in frames} >= {"3d", "6d", "analog", "force"}
    newest: dict[str, int] = {}
    for frame in frames:
        assert frame.gap == frame.sequence - newest.get(frame.key, frame.sequence - 1) - 1
        newest[frame.key] = frame.sequence
        assert 0 <= frame.age_s < 3600
        if frame.key == "3d":
            assert frame.markers.labels[0] == "Marker 1"
            assert frame.markers.unit == "mm"
    samples = [(frame, frame.series["analog"]) for frame in joined if "analog" in frame.rows]
    assert all(series.timestamp_us.max() <= frame.timestamp_us for frame, series in samples)
    numbers = np.concatenate([series.sequence for _, series in samples])
    assert 0 <= (np.diff(numbers) - 1).sum() <= sum(frame.gap for frame, _ in samples[1:])
    assert len(numbers) > len(joined)
    found, recorded = collected.sources["lab"].series, take.sources["lab"].series
    for key in ("3d", "6d", "analog", "force"):
        here = np.isin(found[key].sequence, recorded[key].sequence)
        there = np.isin(recorded[key].sequence, found[key].sequence)
        assert here.sum() > 10
        assert found[key].items[here].tobytes() == recorded[key].items[there].tobytes()
        assert found[key].capture_utime[here].tolist() == recorded[key].capture_utime[there].tolist()
        assert (found[key].labels, found[key].units) == (recorded[key].labels, recorded[key].units)


async def test_a_late_joiner_gets_what_the_gateway_has_kept_and_then_the_live_data(
    where: tuple[dict[str, Any], dict[str, Any]],
) -> None:
    """In order, and each message once, however late the program asks for frames.

    That some are old does not make the clocks of the hosts differ.
    """
    gateway_options, options = where
    scene = SyntheticScene(markers=2, rate_hz=100.0)
    async with (
        Simulator(scene) as simulator,
        run_gateway(simulator.port, **gateway_options) as gateway,
    ):
        await wait_until_cached(gateway)
        await wait_until_async(lambda: gateway.sources[0].statuses[0].frames_in > 50)

        def receive() -> list[int]:
            with live("lab", components=["3d"], last_s=30, **options) as data:
                wait_until(lambda: data.latest("3d") is not None)
                frames = [frame for frame, _ in zip(data, range(150), strict=False)]
            assert frames[0].capture_time == frames[0].capture_utime / 1e6
            return [frame.sequence for frame in frames]

        assert await asyncio.to_thread(receive) == list(range(150))


@pytest.mark.parametrize("components", [None, ["6d"]], ids=["all", "6d"])
async def test_poses_of_single_tools_are_not_received(
    where: tuple[dict[str, Any], dict[str, Any]], components: list[str] | None
) -> None:
    """They repeat what 6d has, so a tool would cost as much as all of them do."""
    gateway_options, options = where
    async with (
        Simulator(SyntheticScene(tools=2, rate_hz=100.0)) as simulator,
        run_gateway(simulator.port, tool_poses=True, **gateway_options) as gateway,
    ):
        await wait_until_cached(gateway)

        client = GatewayClient(GatewayAddress(is_lcm="url" in options, **options))

        def receive() -> set[str]:
            # Zenoh's history has poses once somebody has subscribed to them.
            poses = client.subscribe(("lab",), ["6d"], Messages(lambda *_: None))
            with closing(poses), live("lab", components=components, last_s=30, **options) as data:
                tools = (frame for frame in data if frame.key == "6d")
                assert len([frame for frame, _ in zip(tools, range(100), strict=False)]) == 100
                return {series.key for series in data._reception.all_series}

        keys = await asyncio.to_thread(receive)
        assert [key for key in keys if key.startswith("6d")] == ["6d"]


async def test_frames_can_be_awaited_beside_a_gateway_in_one_event_loop() -> None:
    endpoint = free_endpoint()
    async with (
        Simulator(SyntheticScene()) as simulator,
        run_gateway(simulator.port, listen=endpoint) as gateway,
    ):
        await wait_until_cached(gateway)
        async with live("lab", components=["6d"], connect=endpoint) as data:
            async for frame in data:
                assert frame.tools.quaternions.shape == (2, 4)
                break
