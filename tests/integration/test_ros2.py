"""A gateway's topics as another implementation of rmw_zenoh receives them, and beside its Zenoh keys."""

import asyncio
import itertools
import json
import sys
from asyncio.subprocess import PIPE
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, Final

import numpy as np
import pytest
import rtc3d
import zenoh

from gateway.config.settings import MetricsSettings, ReconnectSettings, SourceSettings, StreamSettings
from gateway.config.transform import TransformSettings
from gateway.gateway import Gateway
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.ros2.message_types import ROS_TYPES
from gateway.outputs.ros2.settings import Ros2Settings
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType, encode_component
from gateway.rtc3d.frames import encode_frame
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.stream.state import StreamState
from tests.configurations import make_settings
from tests.networks import free_endpoint, open_zenoh, zenoh_keys
from tests.running_gateway import running_gateway
from tests.servers import Client, ScriptedServer, error, markers_frame, ok, packet
from tests.unit.outputs.ros2 import ros_messages as ros
from tests.waiting import wait_until_async

TYPES: Final = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/mocap/hall_2/Tool_1/pose": "geometry_msgs/msg/PoseStamped",
    "/mocap/hall_2/markers": "sensor_msgs/msg/PointCloud2",
    "/mocap/hall_2/analog": "std_msgs/msg/Float32MultiArray",
    "/mocap/hall_2/force_1/wrench": "geometry_msgs/msg/WrenchStamped",
}
"""A topic of each type."""


def settings_of(router: str, sources: dict[str, int], **sections: Any) -> Any:
    """Return settings with sources by name and port, for ROS on ``router`` only."""
    return make_settings(
        sources=tuple(
            SourceSettings(
                name=name,
                host="127.0.0.1",
                port=port,
                reconnect=ReconnectSettings(first_delay_s=0.01, max_delay_s=0.05),
            )
            for name, port in sources.items()
        ),
        **{
            "zenoh": ZenohSettings(enabled=False),
            "lcm": LcmSettings(enabled=False),
            "ros2": Ros2Settings(enabled=True, connect=router),
            "metrics": MetricsSettings(enabled=False),
            **sections,
        },
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
            *(sys.executable, "-m", "tests.ros2_listener", port, "0", *arguments), stdout=PIPE
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
    assert messages["/diagnostics"]["status"][0]["name"].startswith("rtc3d_gateway: hall-2")

    assert {topic: types for topic, types in heard["topics"].items() if topic in TYPES} == {
        topic: [type_name] for topic, type_name in TYPES.items()
    }
    hashes = {each.name: each.type_hash for each in ROS_TYPES}
    for topic, type_name in TYPES.items():
        [publisher] = heard["publishers"][topic]
        assert (publisher["node_name"], publisher["node_namespace"]) == ("rtc3d_gateway", "/mocap")
        assert publisher["type_hash"] == hashes[type_name]
        assert publisher["qos"].startswith("2:")  # best effort
        numbers = [sequence for sequence, _, _ in heard["attachments"][topic]]
        assert numbers == [*range(numbers[0], numbers[0] + len(numbers))]
        assert numbers[0] >= 1
        times = [source_time_ns for _, source_time_ns, _ in heard["attachments"][topic]]
        assert times == sorted(times)
        assert len({gid for _, _, gid in heard["attachments"][topic]}) == 1


async def test_poses_have_the_values_and_the_capture_times_of_the_component(router: str) -> None:
    endpoint = free_endpoint()
    tools: dict[int, Any] = {}
    poses: dict[int, Any] = {}

    def on_tools(sample: zenoh.Sample) -> None:
        message = rtc3d.tools_t.decode(sample.payload.to_bytes())
        tools[message.capture_utime] = message.tools[0]

    def on_pose(sample: zenoh.Sample) -> None:
        message = ros.decoded(sample.payload.to_bytes(), "geometry_msgs/msg/PoseStamped")
        time = message.header.stamp
        poses[time.sec * 1_000_000 + time.nanosec // 1000] = message.pose

    zenoh_settings = ZenohSettings(config=zenoh_keys("peer", listen=endpoint))
    async with simulated() as server:
        settings = settings_of(router, {"lab": server}, zenoh=zenoh_settings)
        async with gateway_of(settings):
            with open_zenoh("client", connect=endpoint) as peer, open_zenoh("client", connect=router) as node:
                peer.declare_subscriber("mocap/lab/6d", on_tools)
                node.declare_subscriber("0/mocap/lab/Tool_1/pose/**", on_pose)
                await wait_until_async(lambda: len(tools.keys() & poses.keys()) >= 20)
    for utime in tools.keys() & poses.keys():
        tool, pose = tools[utime], poses[utime]
        ours = (pose.position.x, pose.position.y, pose.position.z, pose.orientation.x, pose.orientation.w)
        assert ours == pytest.approx((tool.x / 1000, tool.y / 1000, tool.z / 1000, tool.qx, tool.q0))


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


async def test_frames_are_requested_only_while_ros_wants_them(router: str) -> None:
    received: list[zenoh.Sample] = []
    async with simulated() as server:
        settings = settings_of(router, {"lab": server})
        stream = StreamSettings(on_demand=True, idle_after_s=0.1)
        source = settings.sources[0].model_copy(update={"streams": (stream,)})
        async with gateway_of(settings.model_copy(update={"sources": (source,)})) as gateway:
            [running] = gateway._sources["lab"]._streams.streams
            with open_zenoh("client", connect=router) as node:
                for _ in range(2):
                    await wait_until_async(lambda: running.status.state is StreamState.IDLE)
                    received.clear()
                    subscriber = node.declare_subscriber("0/mocap/lab/markers/**", received.append)
                    await wait_until_async(lambda: received)
                    subscriber.undeclare()


MARKERS_ONLY: Final = """<RT_Parameters Ver='1.00'><The_3D><Frequency>100</Frequency><Unit>mm</Unit>
<Markers><Marker id='1'><Label>a</Label></Marker></Markers></The_3D></RT_Parameters>"""


def tool_frame(number: int) -> bytes:
    """Return a data frame with one tool."""
    items = np.array([(1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 0.1)], ITEM_DTYPES[ComponentType.TOOLS])
    component = encode_component(ComponentType.TOOLS, number, 10_000 * number, items)
    return packet(3, encode_frame([component]))


async def test_a_component_that_the_parameters_lack_has_topics_before_anybody_subscribes(router: str) -> None:
    async def serve(client: Client) -> None:
        def answer(command: str) -> bytes:
            if command.startswith("SendParameters"):
                return packet(2, MARKERS_ONLY)
            return ok(f"OK-{command}")

        async def stream() -> None:
            for number in itertools.count(1):
                client.send(markers_frame(number, (1.0, 2.0, 3.0)))
                client.send(tool_frame(number))
                await asyncio.sleep(0.01)

        await asyncio.gather(client.commands(answer), stream())

    async with ScriptedServer(serve) as server, gateway_of(settings_of(router, {"lab": server.port})):
        with open_zenoh("client", connect=router) as node:
            await wait_until_async(
                lambda: {"/mocap/lab/markers", "/mocap/lab/tool_1/pose"} <= topics_on(node)
            )


async def test_a_server_that_gives_no_parameters_has_topics_by_position(router: str) -> None:
    async def refuse(client: Client) -> None:
        def answer(command: str) -> bytes:
            return error("err-unknown") if command.startswith("SendParameters") else ok(f"OK-{command}")

        async def stream() -> None:
            for number in itertools.count(1):
                client.send(markers_frame(number, (1.0, 2.0, 3.0)))
                await asyncio.sleep(0.01)

        await asyncio.gather(client.commands(answer), stream())

    received: list[zenoh.Sample] = []
    async with ScriptedServer(refuse) as server:
        settings = settings_of(router, {"lab": server.port})
        source = settings.sources[0].model_copy(
            update={"frame_id": "world", "transform": TransformSettings(units="m")}
        )
        async with gateway_of(settings.model_copy(update={"sources": (source,)})):
            with open_zenoh("client", connect=router) as node:
                await wait_until_async(lambda: "/mocap/lab/markers" in topics_on(node))
                node.declare_subscriber("0/mocap/lab/markers/**", received.append)
                await wait_until_async(lambda: received)
    cloud = ros.decoded(received[0].payload.to_bytes(), "sensor_msgs/msg/PointCloud2")
    assert cloud.header.frame_id == "world"
    assert np.frombuffer(cloud.data.tobytes(), "<f4")[:3].tolist() == [1.0, 2.0, 3.0]
