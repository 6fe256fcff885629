"""Poses in the coordinate frame of a source, and how receivers learn of it."""

import json

import numpy as np
import pytest
import rtc3d

from gateway.messages.decode import decode
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.networks import free_endpoint, lcm_url
from tests.queried_gateway import query, run_gateway, wait_until_cached, zenoh_peer
from tests.waiting import wait_until_async

Y_UP = {"scale": 2.0, "up": "y", "translation_m": [10.0, 0.0, 1.0]}
HALF = 0.5**0.5
FRAME = {
    "frame_id": "world",
    "metres_per_unit": 0.002,
    "rotation_xyzw": [HALF, 0.0, 0.0, HALF],
    "translation_m": [10.0, 0.0, 1.0],
}


def scene() -> SyntheticScene:
    return SyntheticScene(markers=24, tools=4, analog=0, plates=0, rate_hz=100)


async def test_poses_are_transformed_and_component_messages_are_not() -> None:
    endpoint = free_endpoint()
    poses: dict[int, rtc3d.tool_pose_t] = {}
    tools: dict[int, rtc3d.tools_t] = {}

    def visible_in_both() -> list[int]:
        return [number for number in poses.keys() & tools.keys() if poses[number].visible]

    async with (
        Simulator(scene()) as simulator,
        run_gateway(
            simulator.port, listen=endpoint, tool_poses=True, frame_id="world", transform=Y_UP
        ) as gateway,
    ):
        await wait_until_cached(gateway)
        with zenoh_peer(endpoint) as peer:

            def on_pose(message: bytes) -> None:
                pose = decode(message)
                poses[pose.frame_number] = pose

            def on_tools(message: bytes) -> None:
                each = decode(message)
                tools[each.frame_number] = each

            peer.declare_subscriber(
                "mocap/lab/6d/Tool%201", lambda sample: on_pose(sample.payload.to_bytes())
            )
            peer.declare_subscriber("mocap/lab/6d", lambda sample: on_tools(sample.payload.to_bytes()))
            await wait_until_async(visible_in_both)
    number = visible_in_both()[0]
    tool, pose = tools[number].tools[0], poses[number]
    x, y, z = pose.position_m
    # 2 mm for each mm, y up to z up, then 10 m along x and 1 m up.
    np.testing.assert_allclose(
        [x, y, z], [tool.x * 0.002 + 10, -tool.z * 0.002, tool.y * 0.002 + 1], rtol=1e-5
    )
    assert pose.error_m == pytest.approx(tool.error * 0.002)
    w = HALF * tool.q0 - HALF * tool.qx
    assert pose.orientation_xyzw[3] == pytest.approx(w, abs=1e-5)


async def test_receivers_on_zenoh_learn_the_frame() -> None:
    endpoint = free_endpoint()
    async with (
        Simulator(scene()) as simulator,
        run_gateway(simulator.port, listen=endpoint, frame_id="world", transform=Y_UP) as gateway,
    ):
        await wait_until_cached(gateway)
        with zenoh_peer(endpoint) as peer:
            reply = await query(peer, "mocap/lab/frame")
            parameters = await query(peer, "mocap/lab/parameters")
            refused = await query(peer, "mocap/lab/frame?format=json")
            status = decode((await query(peer, "mocap/lab/status")).payload)
    assert (reply.json, reply.encoding) == ({**FRAME, "names": {}}, "application/json")
    assert parameters.attachment["frame"] == FRAME
    assert (refused.error, refused.code) == ("frame takes no options", "bad-request")
    assert {name: getattr(status, name) for name in FRAME} == {
        name: tuple(value) if isinstance(value, list) else value for name, value in FRAME.items()
    }


@pytest.mark.netns
async def test_receivers_on_lcm_can_ask_for_the_frame() -> None:
    url = lcm_url()
    replies: list[rtc3d.command_reply_t] = []
    async with (
        Simulator(scene()) as simulator,
        run_gateway(
            simulator.port, lcm_url=url, queries_url=url, frame_id="world", transform=Y_UP
        ) as gateway,
    ):
        await wait_until_cached(gateway)
        connection = open_lcm(url)
        subscriber = LcmSubscriber(
            connection, "MOCAP_LAB_COMMAND_REPLY", lambda _, message: replies.append(decode(message))
        )
        request = rtc3d.command_request_t()
        request.requester, request.command = "test", "frame"
        connection.publish("MOCAP_LAB_COMMAND_REQUEST", request.encode())
        await wait_until_async(lambda: replies)
        subscriber.close()
    assert json.loads(replies[0].content) == {**FRAME, "names": {}}
