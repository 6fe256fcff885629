"""A gateway behind a gateway publishes the same component bytes, on real Zenoh."""

import os
from collections import defaultdict
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from gateway.messages.encode import CONTENT_OFFSET
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.outputs.zenoh.subscriber import ZenohSubscriber, open_zenoh
from gateway.rtc3d.components import COMPONENTS_BY_KEY
from gateway.session.server.scene import Scene
from gateway.session.state import StreamState
from gateway.simulator.c3d_scene import C3dScene
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.support.gateways import ServingGateway, serving_gateway
from tests.support.networks import zenoh_keys
from tests.support.waiting import wait_until_async

_NUMBER_AND_TIME_BYTES = 12

Contents = dict[str, dict[bytes, bytes]]
"""By component, what follows the prefix of each message, by its frame number and time stamp."""


def zenoh_output(prefix: str, router: str) -> ZenohOutput:
    return ZenohOutput(ZenohSettings(prefix=prefix, config=zenoh_keys("client", connect=router)))


@asynccontextmanager
async def two_gateways(
    simulator: Simulator, router: str, byte_order: str
) -> AsyncIterator[tuple[ServingGateway, ServingGateway]]:
    """Run a gateway in front of a simulator, and another one in front of the first."""
    outputs = [zenoh_output(prefix, router) for prefix in ("first", "second")]
    settings: Any = {"is_streaming": False, "stall_timeout_s": 60.0}  # a new connection would lose frames
    async with (
        serving_gateway(simulator, outputs=outputs[:1], **settings) as first,
        serving_gateway(first, outputs=outputs[1:], byte_order=byte_order, **settings) as second,
    ):
        for gateway in (first, second):
            await wait_until_async(
                lambda gateway=gateway: all(  # type: ignore[misc]
                    status.state is StreamState.NO_MEASUREMENT for status in gateway.source.statuses
                )
            )
        assert len(first.source.statuses) == len(second.source.statuses)
        yield first, second


async def contents_of_both(
    scene: Scene, router: str, num_frames: int, byte_order: str = "big"
) -> tuple[Contents, Contents]:
    """Play some frames; return what a subscriber receives from the first and the second gateway.

    No frame is lost on the way: both gateways have got as many as the simulator has sent.
    """
    contents: dict[str, Contents] = {"first": defaultdict(dict), "second": defaultdict(dict)}

    def receive(key: str, message: bytes) -> None:
        prefix, _, component = key.split("/")
        content = message[CONTENT_OFFSET:]
        contents[prefix][component][content[:_NUMBER_AND_TIME_BYTES]] = content

    session = open_zenoh(router)
    try:
        for prefix in contents:
            for component in COMPONENTS_BY_KEY:
                ZenohSubscriber(session, [f"{prefix}/lab/{component}"], receive)
        async with Simulator(scene) as simulator:
            simulator.stop_measurement()
            async with two_gateways(simulator, router, byte_order) as gateways:
                simulator.start_measurement()
                await wait_until_async(lambda: len(contents["second"]["3d"]) >= num_frames)
                simulator.stop_measurement()
                sent = simulator.components_sent
                for gateway in gateways:
                    await wait_until_async(
                        lambda gateway=gateway: num_arrived(gateway) == sent  # type: ignore[misc]
                    )
        return contents["first"], contents["second"]
    finally:
        session.close()


def num_arrived(gateway: ServingGateway) -> dict[str, int]:
    return {component.key: count for component, count in gateway.source.fan_out.frames.items() if count}


def check_equal(first: Contents, second: Contents) -> None:
    """Check that both sent the same in the messages that arrived: on a busy computer, Zenoh drops some."""
    assert set(first) == set(second)
    for component, contents in first.items():
        common = contents.keys() & second[component].keys()
        assert common, component
        assert all(contents[each] == second[component][each] for each in common)


@pytest.mark.parametrize("byte_order", ["big", "little"])
async def test_a_gateway_behind_a_gateway_publishes_the_same_bytes(router: str, byte_order: str) -> None:
    scene = SyntheticScene(markers=10, tools=3, analog=6, plates=2, rate_hz=100)
    first, second = await contents_of_both(scene, router, 300, byte_order)
    assert set(second) == {"3d", "6d", "analog", "force", "event"}
    check_equal(first, second)


@pytest.mark.takes
@pytest.mark.parametrize("name", ["qualisys.c3d", "optotrak.c3d"])
async def test_a_real_recording_passes_two_gateways_unchanged(router: str, name: str) -> None:
    scene = C3dScene(Path(os.environ["RTC3D_TAKES"]) / name)
    check_equal(*await contents_of_both(scene, router, 100))
