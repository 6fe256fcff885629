"""Real recordings, from the file through simulator, TCP and gateway to subscribers on Zenoh and LCM."""

import os
from collections import defaultdict
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import ezc3d
import lcm
import numpy as np
import numpy.typing as npt
import pytest

from gateway.config.settings import StreamSettings
from gateway.daemon.gateway import Gateway
from gateway.messages.encode import ITEMS_OFFSET
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.lcm.subscriber import LcmSubscriber, channel_pattern
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.outputs.zenoh.subscriber import ZenohSubscriber, key_patterns, open_zenoh
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ITEM_DTYPES, ComponentType
from gateway.session.server.scene import Scene
from gateway.simulator.c3d_scene import C3dScene
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.support.configurations import local_settings, local_source
from tests.support.gateways import running_gateway
from tests.support.networks import free_endpoint, lcm_url, zenoh_keys
from tests.support.waiting import wait_until_async

pytestmark = pytest.mark.netns

ANALOG = StreamSettings(components=(ComponentType.ANALOG,))
OTHERS = StreamSettings(
    components=(ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.FORCE, ComponentType.EVENT)
)

Bits = npt.NDArray[np.uint32]
Received = dict[str, list[bytes]]


class Lab:
    """A simulator, and the messages that one subscriber each on Zenoh and LCM received, by component."""

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self.zenoh: Received = defaultdict(list)
        self.lcm: Received = defaultdict(list)


@asynccontextmanager
async def lab(scene: Scene, *streams: StreamSettings) -> AsyncIterator[Lab]:
    """Run simulator, gateway and subscribers; start the measurement once both subscribers receive."""
    endpoint, url = free_endpoint(), f"{lcm_url()}&recv_buf_size=2000000"
    async with Simulator(scene) as simulator:
        simulator.stop_measurement()
        settings = local_settings(
            local_source(simulator.port, streams=streams),
            zenoh=ZenohSettings(config=zenoh_keys("peer", listen=endpoint)),
            lcm=LcmSettings(url=url),
        )
        async with running_gateway(Gateway(settings)) as gateway:
            await gateway.opened.wait()
            running, session = Lab(simulator), open_zenoh(endpoint)
            listener = LcmSubscriber(
                lcm.LCM(url),
                channel_pattern("MOCAP", "lab", None),
                lambda channel, message: running.lcm[channel.rsplit("_", 1)[-1].lower()].append(message),
            )
            try:
                ZenohSubscriber(
                    session,
                    key_patterns("mocap", "lab", None),
                    lambda key, message: running.zenoh[key.rsplit("/", 1)[-1]].append(message),
                )
                await wait_until_async(lambda: running.zenoh["status"] and running.lcm["status"])
                simulator.start_measurement()
                yield running
            finally:
                session.close()
                listener.close()


def take_path(name: str) -> Path:
    return Path(os.environ["RTC3D_TAKES"]) / name


def expected_bits(path: Path) -> dict[str, Bits]:
    """Return the values that ezc3d reads from a file, as float32 bits, shape (samples, items, values)."""
    content = ezc3d.c3d(str(path), extract_forceplat_data=True)
    points = content["data"]["points"][:3].transpose(2, 1, 0).astype(np.float32)
    bits = points.view(np.uint32).reshape(points.shape).copy()
    bits[np.isnan(points).any(axis=2)] = 0xFFFFFFFF
    expected = {"3d": bits}
    analogs = content["data"]["analogs"][0].T.astype(np.float32)
    expected["analog"] = np.ascontiguousarray(analogs).view(np.uint32)[:, :, np.newaxis]
    plates = [np.concatenate([plate["force"], plate["moment"]]).T for plate in content["data"]["platform"]]
    if plates:
        loads = np.ascontiguousarray(np.stack(plates, axis=1).astype(np.float32))
        expected["force"] = loads.view(np.uint32)
    return expected


def assert_equal_to_file(messages: list[bytes], component: str, expected: Bits) -> None:
    """Compare every value of every message with the file; frames are numbered from 1 and the take loops."""
    seen = set()
    for message in messages:
        number = int.from_bytes(message[40:44], "big", signed=True) - 1
        items = np.frombuffer(message, ITEM_DTYPES[COMPONENTS_BY_KEY[component]], offset=ITEMS_OFFSET)
        bits = items.view(">u4").reshape(len(items), -1)[:, : expected.shape[2]]
        np.testing.assert_array_equal(bits, expected[number % len(expected)])
        seen.add(number % len(expected))
    assert len(seen) >= 0.02 * len(expected)  # a busy computer skips frames


@pytest.mark.takes
@pytest.mark.parametrize(
    ("name", "frames", "components"),
    [("qualisys.c3d", 340, ["3d", "analog", "force"]), ("optotrak.c3d", 29, ["3d"])],
)
async def test_every_value_that_arrives_is_the_one_in_the_file(
    name: str, frames: int, components: list[str]
) -> None:
    path = take_path(name)
    expected = expected_bits(path)
    async with lab(C3dScene(path), OTHERS, ANALOG) as running:
        await wait_until_async(lambda: min(len(side["3d"]) for side in (running.zenoh, running.lcm)) > frames)
        running.simulator.stop_measurement()
    for side in (running.zenoh, running.lcm):
        has_events = name == "qualisys.c3d"
        assert set(side) - {"status", "clock", "parameters"} == {*components, *["event"] * has_events}
        for component in components:
            assert_equal_to_file(side[component], component, expected[component])
    if name == "optotrak.c3d":
        assert (expected["3d"] == 0xFFFFFFFF).any()


async def test_nothing_is_lost_in_five_seconds_with_analog_at_2000_hz() -> None:
    scene = SyntheticScene(markers=55, tools=6, analog=69, plates=2, rate_hz=200, analog_rate_hz=2000)
    async with lab(scene, OTHERS, ANALOG) as running:
        await wait_until_async(lambda: running.simulator.components_sent["analog"] >= 10_000)
        running.simulator.stop_measurement()
        sent = running.simulator.components_sent
        assert sent["3d"] >= 990

        def all_received() -> bool:
            return all(
                len(side[key]) >= count
                for side in (running.zenoh, running.lcm)
                for key, count in sent.items()
            )

        await wait_until_async(all_received)
    for side in (running.zenoh, running.lcm):
        for component, count in sent.items():
            sequences = [int.from_bytes(message[24:32], "big") for message in side[component]]
            assert sequences == list(range(count)), component
