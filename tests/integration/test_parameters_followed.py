"""Names that change while the server runs, and servers that give no names any more, for all who listen."""

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import rtc3d
import zenoh

from gateway.messages.decode import decode, prefix_of
from gateway.outputs.lcm import parameters as lcm_parameters
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.rtc3d.components import ComponentType
from gateway.simulator.faults.server_faults import Rename
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.integration.test_parameters_published import subscribe_with_history
from tests.networks import lcm_url, open_zenoh
from tests.queried_gateway import ParameterServer, query, run_gateway, wait_until_cached, zenoh_peer
from tests.servers import ScriptedServer
from tests.waiting import wait_until_async

pytestmark = pytest.mark.netns
KEY = "mocap/lab/parameters"


class Listener:
    """Everything that one transport carries, in the order in which it arrives: names, versions, tool keys."""

    def __init__(self) -> None:
        self.xml: list[bytes] = []
        self.versions: set[int] = set()
        """The versions of the parameters that have arrived."""
        self.frame_version = 0
        """The version of the newest frame."""
        self.early_versions: set[int] = set()
        """The versions of frames that arrived before the parameters."""
        self.poses: set[str] = set()
        """The keys or channels of poses per tool."""

    def on_parameters(self, xml: bytes, version: int) -> None:
        self.xml.append(xml)
        self.versions.add(version)

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
        subscribe_with_history(peer, received)
        await wait_until_async(lambda: received)
    return received[0]


async def test_renamed_markers_and_tools_reach_everyone_before_their_frames(
    router: str, caplog: pytest.LogCaptureFixture
) -> None:
    url = lcm_url()
    scene = SyntheticScene(markers=2, tools=1, analog=0, plates=0, rate_hz=500)
    with listeners(router, url) as (on_zenoh, on_lcm):
        async with (
            Simulator(scene) as simulator,
            run_gateway(
                simulator.port, router=router, lcm_url=url, tool_poses=True, parameters_interval_s=0.2
            ),
        ):
            await wait_until_async(lambda: on_zenoh.frame_version == 1 and on_lcm.frame_version == 1)
            await wait_until_async(lambda: "6d/Tool%201" in on_zenoh.poses)
            simulator.faults.begin(Rename(prefix="Left "))
            await wait_until_async(lambda: on_zenoh.frame_version == 2 and on_lcm.frame_version == 2)
            for listener in (on_zenoh, on_lcm):
                assert b"<Label>Left Marker 2</Label>" in listener.xml[-1]
            await wait_until_async(lambda: "6d/Left%20Tool%201" in on_zenoh.poses)
            await wait_until_async(lambda: "MOCAP_LAB_6D_LEFT_TOOL_1" in on_lcm.poses)
            with zenoh_peer(router) as peer:
                reply = await query(peer, f"{KEY}/3d?format=json")
                assert reply.attachment["parameters_version"] == 2
                assert [marker["label"] for marker in reply.json["markers"]] == [
                    *("Left Marker 1", "Left Marker 2")
                ]
            assert b"Left Marker 2" in await late_parameters(router)
    assert (on_zenoh.early_versions, on_lcm.early_versions) == (set(), set())
    assert (on_zenoh.versions, on_lcm.versions) == ({1, 2}, {1, 2})
    [warning] = [
        record.message
        for record in caplog.records
        if record.levelno == logging.WARNING and "were renamed" in record.message
    ]
    assert "3d 'Marker 1' to 'Left Marker 1', 'Marker 2' to 'Left Marker 2'; 6d 'Tool 1' to" in warning


async def test_a_server_that_gives_no_parameters_any_more_makes_them_void_for_everyone(
    router: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lcm_parameters, "REPEAT_S", 0.05)
    server, url = ParameterServer(), lcm_url()
    with listeners(router, url) as (on_zenoh, on_lcm):
        async with (
            ScriptedServer(server.script) as listening,
            run_gateway(listening.port, router=router, lcm_url=url) as gateway,
        ):
            await wait_until_cached(gateway)
            await wait_until_async(lambda: on_zenoh.frame_version == 1 and on_lcm.frame_version == 1)
            server.refused_commands = ("SendParameters",)  # another program on the same port
            assert server.client is not None
            server.client.cut()
            await wait_until_async(lambda: on_zenoh.frame_version == 2 and on_lcm.frame_version == 2)
            for listener in (on_zenoh, on_lcm):
                assert listener.xml[-1] == b""
                assert listener.early_versions == set()
            repeats = len(on_lcm.xml)
            await wait_until_async(lambda: len(on_lcm.xml) > repeats + 1)
            assert on_lcm.xml[repeats:] == [b""] * len(on_lcm.xml[repeats:])
            assert await late_parameters(router) == b""
            with zenoh_peer(router) as peer:
                reply = await query(peer, KEY)
            assert reply.code == "refused"
            assert "the parameters of its earlier connections are void" in reply.error
            server.refused_commands = ()
            server.client.cut()
            await wait_until_async(lambda: on_zenoh.frame_version == 3 and on_lcm.frame_version == 3)
            assert on_zenoh.xml[-1] == server.xml


async def test_long_parameters_are_parsed_again_only_if_they_change(router: str) -> None:
    """The XML has nearly 900 kB, and its statistics differ in every reply."""
    scene = SyntheticScene(markers=8000, tools=0, analog=0, plates=0, rate_hz=50)
    async with (
        Simulator(scene) as simulator,
        run_gateway(simulator.port, router=router, parameters_interval_s=0.1) as gateway,
    ):
        [source] = gateway.sources
        known = source.queries.parameters.known
        await wait_until_async(lambda: known.newest)
        first = known.newest
        assert first is not None
        assert len(first.xml) > 800_000
        await wait_until_async(lambda: known.newest is not first)
        assert known.newest is not None
        assert known.newest.parsed.parameters.markers is first.parsed.parameters.markers  # not parsed again
        assert known.version == 1
        await wait_until_async(lambda: source.fan_out.newest(ComponentType.MARKERS, "zenoh"))
