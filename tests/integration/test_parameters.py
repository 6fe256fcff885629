"""Parameters and names as present and late subscribers on Zenoh and LCM get them, without a query."""

import json
import logging
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from typing import Any

import pytest
import rtc3d
import zenoh
import zenoh.ext

from gateway.daemon.gateway import Gateway
from gateway.messages.decode import decode, prefix_of
from gateway.outputs.lcm import output as lcm_parameters
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.simulator.faults import Rename
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.support.errors import names
from tests.support.networks import lcm_url, open_zenoh
from tests.support.queried_gateway import (
    ParameterServer,
    query,
    run_gateway,
    wait_until_cached,
    zenoh_peer,
)
from tests.support.servers import ScriptedServer
from tests.support.waiting import wait_until_async

pytestmark = pytest.mark.netns
KEY = "mocap/lab/parameters"


class Listener:
    """Everything that one transport carries, in the order in which it arrives: names, versions, tool keys."""

    def __init__(self) -> None:
        self.xml: list[bytes] = []
        self.versions: list[int] = []
        """The version of each of ``xml``."""
        self.frame_version = 0
        """The version of the newest frame."""
        self.early_versions: set[int] = set()
        """The versions of frames that arrived before the parameters."""
        self.poses: set[str] = set()
        """The keys or channels of poses per tool."""

    def on_parameters(self, xml: bytes, version: int) -> None:
        self.versions.append(version)
        self.xml.append(xml)

    def on_frame(self, version: int) -> None:
        self.frame_version = version
        if version not in self.versions:
            self.early_versions.add(version)

    def on_zenoh(self, sample: zenoh.Sample) -> None:
        key, data = str(sample.key_expr).removeprefix("mocap/lab/"), sample.payload.to_bytes()
        if key == "parameters":
            assert sample.attachment is not None
            self.on_parameters(data, json.loads(sample.attachment.to_bytes())["parameters_version"])
        elif key == "3d":
            self.on_frame(prefix_of(data).parameters_version)
        elif key.startswith("6d/"):
            self.poses.add(key)

    def on_lcm(self, channel: str, data: bytes) -> None:
        match decode(data):
            case rtc3d.parameters_t() as message:
                self.on_parameters(message.xml.encode(), message.parameters_version)
            case rtc3d.markers_t() as message:
                self.on_frame(message.parameters_version)
            case rtc3d.tool_pose_t():
                self.poses.add(channel)

    async def wait_for(self, xml: bytes) -> None:
        await wait_until_async(lambda: self.xml and self.xml[-1] == xml)

    async def wait_for_frame(self, version: int) -> None:
        await wait_until_async(lambda: self.frame_version == version)


@contextmanager
def listeners(router: str, url: str) -> Iterator[tuple[Listener, Listener]]:
    """Listen on Zenoh and on LCM."""
    on_zenoh, on_lcm = Listener(), Listener()
    session = open_zenoh("client", connect=router)
    session.declare_subscriber("mocap/lab/**", on_zenoh.on_zenoh)
    subscriber = LcmSubscriber(open_lcm(url), "MOCAP_LAB_.*", on_lcm.on_lcm)
    try:
        yield on_zenoh, on_lcm
    finally:
        subscriber.close()
        session.close()


async def late_parameters(router: str) -> bytes:
    """Return what a late AdvancedSubscriber gets first."""
    received: list[bytes] = []
    with zenoh_peer(router) as peer:
        zenoh.ext.declare_advanced_subscriber(
            peer,
            KEY,
            lambda sample: received.append(sample.payload.to_bytes()),
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
        )
        await wait_until_async(lambda: received)
    return received[0]


@asynccontextmanager
async def gateway_with_cache(server: ParameterServer, router: str, url: str) -> AsyncIterator[Gateway]:
    """Run ``server`` and a gateway on Zenoh and LCM that has cached its parameters."""
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, router=router, lcm_url=url) as gateway,
    ):
        await wait_until_cached(gateway)
        yield gateway


async def test_late_subscribers_get_the_parameters_without_asking_the_server_and_others_not_again(
    router: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lcm_parameters, "REPEAT_S", 0.05)
    server, url = ParameterServer(), lcm_url()
    async with gateway_with_cache(server, router, url):
        commands = list(server.commands)
        with listeners(router, url) as (on_zenoh, on_lcm):
            await on_zenoh.wait_for(server.xml)
            await on_lcm.wait_for(server.xml)  # LCM repeats them for everyone
            with zenoh_peer(router) as peer:
                await query(peer, KEY)  # its reply arrives after everything published before
                num_before = len(on_zenoh.xml)
                assert await late_parameters(router) == server.xml
                await query(peer, KEY)
            assert len(on_zenoh.xml) == num_before
        assert server.commands == commands


async def test_renamed_markers_and_tools_reach_everyone_before_their_frames(
    router: str, caplog: pytest.LogCaptureFixture
) -> None:
    url = lcm_url()
    scene = SyntheticScene(markers=2, tools=1, analog=0, plates=0, rate_hz=500)
    source: dict[str, Any] = {"lcm_url": url, "tool_poses": True, "parameters_interval_s": 0.2}
    with listeners(router, url) as (on_zenoh, on_lcm):
        async with Simulator(scene) as simulator, run_gateway(simulator.port, router=router, **source):
            await on_zenoh.wait_for_frame(1)
            await on_lcm.wait_for_frame(1)
            await wait_until_async(lambda: "6d/Tool%201" in on_zenoh.poses)
            simulator.faults.begin(Rename(prefix="Left "))
            for listener, pose in (
                (on_zenoh, "6d/Left%20Tool%201"),
                (on_lcm, "MOCAP_LAB_6D_LEFT_TOOL_1"),
            ):
                await listener.wait_for_frame(2)
                assert b"<Label>Left Marker 2</Label>" in listener.xml[-1]
                await wait_until_async(partial(listener.poses.__contains__, pose))
            with zenoh_peer(router) as peer:
                reply = await query(peer, f"{KEY}/3d?format=json")
                assert reply.attachment["parameters_version"] == 2
                labels = [marker["label"] for marker in reply.json["markers"]]
                assert labels == ["Left Marker 1", "Left Marker 2"]
            assert b"Left Marker 2" in await late_parameters(router)
    for listener in (on_zenoh, on_lcm):
        assert (listener.early_versions, set(listener.versions)) == (set(), {1, 2})
    [warning] = [
        record.message
        for record in caplog.records
        if record.levelno == logging.WARNING and "were renamed" in record.message
    ]
    assert names(warning, "3d 'Marker 1'", "'Left Marker 1'", "'Marker 2'", "'Left Marker 2'", "6d 'Tool 1'")
