"""A gateway's topics as another implementation of rmw_zenoh receives them."""

import asyncio
import json
import sys
from asyncio.subprocess import PIPE
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from typing import Any, Final

import zenoh
from zenoh.ext import HistoryConfig, declare_advanced_subscriber

from gateway.daemon.gateway import Gateway
from gateway.messages.ros2.encode import ROS_TYPES, TF_MESSAGE
from gateway.outputs.adapters.ros2.settings import Ros2Settings
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.support.configurations import local_settings, local_source
from tests.support.gateways import running_gateway
from tests.support.networks import open_zenoh
from tests.support.waiting import wait_until_async

TYPES: Final = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/mocap/hall_2/Tool_1/pose": "geometry_msgs/msg/PoseStamped",
    "/mocap/hall_2/markers": "sensor_msgs/msg/PointCloud2",
    "/mocap/hall_2/analog": "std_msgs/msg/Float32MultiArray",
    "/mocap/hall_2/force_1/wrench": "geometry_msgs/msg/WrenchStamped",
    "/mocap/hall_2/force_1/centre_of_pressure": "geometry_msgs/msg/PointStamped",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/mocap/hall_2/events": "diagnostic_msgs/msg/DiagnosticArray",
    "/mocap/hall_2/labels": "diagnostic_msgs/msg/DiagnosticArray",
}
"""A topic of each type."""


def settings_of(router: str, sources: dict[str, int], ros2: Ros2Settings | None = None) -> Any:
    """Return settings with sources by name and port, for ROS on ``router`` only."""
    return local_settings(
        *(local_source(port, name) for name, port in sources.items()),
        zenoh=ZenohSettings(enabled=False),
        lcm=LcmSettings(enabled=False),
        ros2=ros2 or Ros2Settings(enabled=True, connect=router),
    )


@asynccontextmanager
async def gateway_of(settings: Any) -> AsyncIterator[Gateway]:
    async with running_gateway(Gateway(settings)) as gateway:
        await gateway.opened.wait()
        yield gateway


@asynccontextmanager
async def simulated() -> AsyncIterator[int]:
    """Run a server with all components; yield its port."""
    scene = SyntheticScene(markers=3, tools=1, analog=2, plates=1, rate_hz=100, analog_rate_hz=200)
    async with Simulator(scene) as simulator:
        yield simulator.port


def topics_on(session: zenoh.Session) -> set[str]:
    """Return the topics that ROS shows."""
    replies = session.liveliness().get("@ros2_lv/*/*/*/*/MP/**")
    return {str(reply.ok.key_expr).split("/")[9].replace("%", "/") for reply in replies if reply.ok}


async def test_another_implementation_receives_every_type_and_sees_the_graph(router: str) -> None:
    arguments = [f"{topic}:{type_name}" for topic, type_name in TYPES.items()]
    port = router.rpartition(":")[2]
    async with simulated() as server, gateway_of(settings_of(router, {"hall-2": server})):
        listener = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "tests.support.ros2_listener", port, "0", *arguments), stdout=PIPE
        )
        output, _ = await listener.communicate()
    heard = json.loads(output.splitlines()[-1])
    messages = heard["messages"]
    assert set(messages) == set(TYPES)
    pose = messages["/mocap/hall_2/Tool_1/pose"]
    assert pose["header"]["frame_id"] == "hall-2"
    assert abs(sum(value**2 for value in pose["pose"]["orientation"].values()) - 1) < 1e-3
    assert messages["/tf"]["transforms"][0]["child_frame_id"] == "hall-2/Tool_1"
    assert messages["/mocap/hall_2/markers"]["width"] == 3
    assert len(messages["/mocap/hall_2/analog"]["data"]) == 2
    assert messages["/mocap/hall_2/force_1/wrench"]["wrench"]["force"]["z"] != 0
    [plate] = messages["/tf_static"]["transforms"]
    assert (plate["header"]["frame_id"], plate["child_frame_id"]) == ("hall-2", "hall-2/force_1")
    assert messages["/mocap/hall_2/force_1/wrench"]["header"]["frame_id"] == "hall-2/force_1"
    [event] = messages["/mocap/hall_2/events"]["status"]
    assert event["name"] == "Button"
    assert {pair["key"] for pair in event["values"]} > {"id"}
    labels = {each["name"]: each["values"] for each in messages["/mocap/hall_2/labels"]["status"]}
    assert labels["tools"] == [{"key": "Tool_1", "value": "Tool 1"}]
    assert len(labels["markers"]) == 3
    assert messages["/diagnostics"]["status"][0]["name"].startswith("rtc3d_gateway: hall-2")

    assert {topic: types for topic, types in heard["topics"].items() if topic in TYPES} == {
        topic: [type_name] for topic, type_name in TYPES.items()
    }
    hashes = {each.name: each.type_hash for each in ROS_TYPES}
    for topic, type_name in TYPES.items():
        [publisher] = heard["publishers"][topic]
        assert (publisher["node_name"], publisher["node_namespace"]) == ("rtc3d_gateway", "/mocap")
        assert publisher["type_hash"] == hashes[type_name]
        is_latched = topic in {"/tf_static", "/mocap/hall_2/labels"}
        assert publisher["qos"].startswith(":1:,1:" if is_latched else "2::")
        numbers = [sequence for sequence, _, _ in heard["attachments"][topic]]
        assert numbers == [*range(numbers[0], numbers[0] + len(numbers))]
        assert numbers[0] >= 1
        times = [source_time_ns for _, source_time_ns, _ in heard["attachments"][topic]]
        assert times == sorted(times)
        assert len({gid for _, _, gid in heard["attachments"][topic]}) == 1


async def test_static_transforms_reach_nodes_that_subscribe_later(router: str) -> None:
    """With the subscription that rmw_zenoh makes if it is transient local, while another is there already."""
    key = f"0/tf_static/{TF_MESSAGE.dds_name}/{TF_MESSAGE.type_hash}"
    async with simulated() as server, gateway_of(settings_of(router, {"lab": server})):
        with open_zenoh("client", connect=router) as first, open_zenoh("client", connect=router) as second:
            for node in (first, second):
                received: list[zenoh.Sample] = []
                history = HistoryConfig(detect_late_publishers=True)
                subscriber = declare_advanced_subscriber(node, key, received.append, history=history)
                await wait_until_async(partial(len, received))
                assert subscriber is not None


async def test_a_reload_adds_and_removes_sources_and_the_output(router: str) -> None:
    with open_zenoh("client", connect=router) as node:
        async with simulated() as server:
            before = settings_of(router, {"lab": server})
            async with gateway_of(before) as gateway:
                await wait_until_async(lambda: "/mocap/lab/markers" in topics_on(node))
                await gateway.reload(settings_of(router, {"lab": server, "hall-2": server}))
                await wait_until_async(lambda: "/mocap/hall_2/markers" in topics_on(node))
                await gateway.reload(settings_of(router, {"hall-2": server}))
                await wait_until_async(lambda: "/mocap/lab/markers" not in topics_on(node))
                assert "/mocap/hall_2/markers" in topics_on(node)
                renamed = Ros2Settings(enabled=True, connect=router, namespace="robots")
                await gateway.reload(settings_of(router, {"hall-2": server}, ros2=renamed))
                await wait_until_async(lambda: "/robots/hall_2/markers" in topics_on(node))
                assert "/mocap/hall_2/markers" not in topics_on(node)
        await wait_until_async(lambda: not topics_on(node))
