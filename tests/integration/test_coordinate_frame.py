"""Poses in the coordinate frame of a source, and how receivers learn of it."""

import json
from typing import Any

import numpy as np
import pytest
import rtc3d
import zenoh

from gateway.config.transform import TransformSettings
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


def collect(peer: zenoh.Session, key: str, messages: dict[int, Any]) -> None:
    """Collect the messages of a key by their frame numbers; of tool poses, only those in view."""

    def receive(sample: zenoh.Sample) -> None:
        message = decode(sample.payload.to_bytes())
        if getattr(message, "visible", True):
            messages[message.frame_number] = message

    peer.declare_subscriber(f"mocap/lab/{key}", receive)


def attachment_of(sample: zenoh.Sample) -> Any:
    assert sample.attachment is not None
    return json.loads(sample.attachment.to_bytes())


def plain(tool: Any) -> list[float]:
    """Return the position of a tool in metres."""
    return [tool.x * 0.001, tool.y * 0.001, tool.z * 0.001]


def y_up(tool: Any) -> list[float]:
    """Return the position of a tool after Y_UP: 2 mm for each mm, y up to z up, 10 m along x and 1 m up."""
    return [tool.x * 0.002 + 10, -tool.z * 0.002, tool.y * 0.002 + 1]


async def test_a_reload_changes_the_frame_of_a_stream_that_goes_on() -> None:
    endpoint = free_endpoint()
    poses: dict[int, rtc3d.tool_pose_t] = {}
    tools: dict[int, rtc3d.tools_t] = {}
    frames: list[dict[str, Any]] = []
    async with (
        Simulator(scene()) as simulator,
        run_gateway(simulator.port, listen=endpoint, tool_poses=True, frame_id="hall") as gateway,
    ):
        await wait_until_cached(gateway)
        with zenoh_peer(endpoint) as peer:
            collect(peer, "6d/Tool%201", poses)
            collect(peer, "6d", tools)
            await wait_until_async(lambda: poses.keys() & tools.keys())
            peer.declare_subscriber(
                "mocap/lab/parameters",
                lambda sample: frames.append(attachment_of(sample)["frame"]),
            )
            moved = gateway.settings.sources[0].model_copy(
                update={"frame_id": "world", "transform": TransformSettings.model_validate(Y_UP)}
            )
            changes = await gateway.reload(gateway.settings.model_copy(update={"sources": (moved,)}))
            await wait_until_async(lambda: FRAME in frames)
            await wait_until_async(lambda: poses[max(poses.keys() & tools.keys())].parameters_version == 2)
    assert changes == ["coordinate frame of source lab changed"]
    in_order = [tools[number] for number in sorted(tools)]
    assert {each.session for each in in_order} == {1}
    assert [each.sequence - in_order[0].sequence for each in in_order] == list(range(len(in_order)))
    # The version of each pose says in which frame it is.
    assert {poses[number].parameters_version for number in poses} == {1, 2}
    for number in poses.keys() & tools.keys():
        expected = plain if poses[number].parameters_version == 1 else y_up
        np.testing.assert_allclose(poses[number].position_m, expected(tools[number].tools[0]), rtol=1e-5)
    newest = max(poses.keys() & tools.keys())
    tool, pose = tools[newest].tools[0], poses[newest]
    assert pose.error_m == pytest.approx(tool.error * 0.002)
    assert pose.orientation_xyzw[3] == pytest.approx(HALF * tool.q0 - HALF * tool.qx, abs=1e-5)


@pytest.mark.netns
async def test_receivers_on_zenoh_and_lcm_learn_the_frame() -> None:
    endpoint, url = free_endpoint(), lcm_url()
    lcm: dict[str, Any] = {"lcm_url": url, "queries_url": url}
    replies: list[rtc3d.command_reply_t] = []
    async with (
        Simulator(scene()) as simulator,
        run_gateway(simulator.port, listen=endpoint, frame_id="world", transform=Y_UP, **lcm) as gateway,
    ):
        await wait_until_cached(gateway)
        with zenoh_peer(endpoint) as peer:
            reply = await query(peer, "mocap/lab/frame")
            parameters = await query(peer, "mocap/lab/parameters")
            refused = await query(peer, "mocap/lab/frame?format=json")
            status = decode((await query(peer, "mocap/lab/status")).payload)
        connection = open_lcm(url)
        subscriber = LcmSubscriber(
            connection, "MOCAP_LAB_COMMAND_REPLY", lambda _, message: replies.append(decode(message))
        )
        request = rtc3d.command_request_t()
        request.requester, request.command = "test", "frame"
        connection.publish("MOCAP_LAB_COMMAND_REQUEST", request.encode())
        await wait_until_async(lambda: replies)
        subscriber.close()
    expected = {**FRAME, "names": {}}
    assert (reply.json, reply.encoding) == (expected, "application/json")
    assert json.loads(replies[0].content) == expected
    assert parameters.attachment["frame"] == FRAME
    assert (refused.error, refused.code) == ("frame takes no options", "bad-request")
    in_status = {name: getattr(status, name) for name in FRAME}
    assert in_status == {key: tuple(each) if isinstance(each, list) else each for key, each in FRAME.items()}
