"""The output for ROS 2 with a real router: topics, messages, losses and life cycle."""

import asyncio
import logging
import math
import threading
import time

import numpy as np
import pytest
import zenoh
import zenoh.ext

from gateway.errors import OutputError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Plate
from tests.ros_lab import (
    ALL,
    ONE_TOOL,
    STAMP,
    RosLab,
    frame_of,
    parameters,
    ros_lab,
    seconds,
    stamp,
    tools_frame,
)
from tests.waiting import wait_until, wait_until_async

# Topics --------------------------------------------------------------------------------------


def test_topics_follow_from_the_parameters(lab: RosLab) -> None:
    plates = (Plate("1", "left"), Plate("2"))
    lab.source(given=parameters(("wand", "Left Foot"), markers=3, channels=("Fx",), plates=plates))
    wait_until(lambda: len(lab.topics()) == 8)
    assert lab.topics() == {
        "/tf",
        "/diagnostics",
        "/mocap/lab/markers",
        "/mocap/lab/analog",
        "/mocap/lab/wand/pose",
        "/mocap/lab/Left_Foot/pose",
        "/mocap/lab/force_1/wrench",
        "/mocap/lab/force_2/wrench",
    }
    assert lab.output.topic_names("lab") == {
        "6d": {"Left Foot": "Left_Foot"},
        "force": {"left": "force_1", "plate 2": "force_2"},
    }


@pytest.mark.parametrize(
    ("settings", "token", "key"),
    [
        (
            {"domain_id": 7, "namespace": "", "distribution": "humble"},
            "@ros2_lv/7/{zid}/0/3/MP/%/%/rtc3d_gateway/%lab%wand%pose/geometry_msgs::msg::dds_::PoseStamped_/"
            "TypeHashNotSupported/2::,10:,:,:,,",
            "7/lab/wand/pose/geometry_msgs::msg::dds_::PoseStamped_/TypeHashNotSupported",
        ),
        (
            {"namespace": "site/mocap", "reliability": "reliable", "depth": 5, "distribution": "rolling"},
            "@ros2_lv/0/{zid}/0/3/MP/%/%site%mocap/rtc3d_gateway/%site%mocap%lab%wand%pose/"
            "geometry_msgs::msg::dds_::PoseStamped_/"
            "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8/::,5:,:,:,,",
            "0/site/mocap/lab/wand/pose/geometry_msgs::msg::dds_::PoseStamped_/"
            "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
        ),
    ],
)
def test_domain_namespace_distribution_and_qos(settings: dict[str, object], token: str, key: str) -> None:
    with ros_lab(**settings) as lab:
        lab.open()
        publisher = lab.source(given=parameters(("wand",)))
        lab.hear_all()
        publisher.publish(tools_frame((1, 2, 3)), stamp(), 0, ALL)
        wait_until(lambda: len(lab.keys) == 2)
        assert key in lab.keys
        [node] = [each for each in lab.tokens() if "/NN/" in each]
        assert token.format(zid=node.split("/")[2]) in lab.tokens()


def test_a_subscription_of_transient_local_durability_gets_messages_too(lab: RosLab) -> None:
    publisher = lab.source(given=parameters(markers=1))
    history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=5)
    received: list[zenoh.Sample] = []
    # As rmw_zenoh_cpp subscribes for transient_local.
    zenoh.ext.declare_advanced_subscriber(
        *(lab.peer, "0/mocap/lab/markers/**", received.append), history=history, subscriber_detection=True
    )
    wait_until(lambda: publisher.wants([ComponentType.MARKERS]))
    publisher.publish(frame_of((ComponentType.MARKERS, [(1, 2, 3, 0)])), stamp(), 0, ALL)
    wait_until(lambda: received)


# Messages ------------------------------------------------------------------------------------


@pytest.mark.parametrize("byte_order", ["big", "little"])
def test_poses_and_transforms_of_visible_tools(lab: RosLab, byte_order: str) -> None:
    publisher = lab.source(given=parameters(("wand", "Left Foot", "cup")))
    lab.hear_all()
    before_ns = time.time_ns()
    frame = tools_frame((1000, -2000, 500), None, (0, 0, 250), byte_order=byte_order)  # type: ignore[arg-type]
    publisher.publish(frame, stamp(), 0, ALL)
    wait_until(lambda: lab.received["/tf"])
    assert set(lab.received) == {"/tf", "/mocap/lab/wand/pose", "/mocap/lab/cup/pose"}
    [received] = lab.received["/mocap/lab/wand/pose"]
    pose = received.message
    assert (pose.header.frame_id, seconds(pose)) == ("lab", STAMP)
    assert (pose.pose.position.x, pose.pose.position.y, pose.pose.position.z) == (1.0, -2.0, 0.5)
    assert (pose.pose.orientation.x, pose.pose.orientation.w) == (0.0, 1.0)
    assert received.sequence == 1
    assert before_ns <= received.source_time_ns <= time.time_ns()
    wand, cup = lab.received["/tf"][0].message.transforms
    assert (wand.header.frame_id, wand.child_frame_id, seconds(wand)) == ("lab", "lab/wand", STAMP)
    assert (cup.child_frame_id, cup.transform.translation.z) == ("lab/cup", 0.25)
    assert lab.received["/mocap/lab/cup/pose"][0].gid != received.gid


def test_markers_are_a_cloud_in_metres(lab: RosLab) -> None:
    publisher = lab.source(given=parameters(markers=2))
    lab.hear_all()
    frame = frame_of((ComponentType.MARKERS, [(1000.0, 2000.0, -500.0, 0.25), None]))
    publisher.publish(frame, stamp(), 0, ALL)
    wait_until(lambda: lab.received["/mocap/lab/markers"])
    cloud = lab.received["/mocap/lab/markers"][0].message
    assert (cloud.header.frame_id, seconds(cloud), cloud.width, cloud.is_dense) == ("lab", STAMP, 2, False)
    points = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(2, 5)
    assert points[0, :4].tolist() == [1.0, 2.0, -0.5, 0.25]
    assert np.isnan(points[1, :3]).all()
    assert points[:, 4].view("<u4").tolist() == [0, 1]


def test_the_source_s_frame_and_transform_apply(lab: RosLab) -> None:
    half = math.sqrt(0.5)
    frame = CoordinateFrame("world", 1e-3, (half, 0.0, 0.0, half), (10.0, 0.0, 0.0))  # y up becomes z up
    publisher = lab.source(given=parameters(("wand",), markers=1, plates=(Plate("1"),), frame=frame))
    lab.hear_all()
    publisher.publish(
        frame_of(
            (ComponentType.MARKERS, [(0.0, 1000.0, 0.0, 0.0)]),
            (ComponentType.TOOLS, [(1.0, 0.0, 0.0, 0.0, 0.0, 1000.0, 0.0, 0.0)]),
            (ComponentType.FORCE, [(0.0, 700.0, 0.0, 1.0, 0.0, 0.0)]),
        ),
        *(stamp(), 0, ALL),
    )
    wait_until(lambda: lab.received["/mocap/lab/force_1/wrench"])
    pose = lab.received["/mocap/lab/wand/pose"][0].message
    assert pose.header.frame_id == "world"
    assert (pose.pose.position.x, round(pose.pose.position.z, 9)) == (10.0, 1.0)
    assert pose.pose.orientation.x == pytest.approx(half)
    [transform] = lab.received["/tf"][0].message.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("world", "lab/wand")
    cloud = lab.received["/mocap/lab/markers"][0].message
    assert np.frombuffer(cloud.data.tobytes(), "<f4")[:3] == pytest.approx([10.0, 0.0, 1.0])
    wrench = lab.received["/mocap/lab/force_1/wrench"][0].message
    assert wrench.wrench.force.z == pytest.approx(700.0)  # not moved
    assert wrench.header.frame_id == "world"


def test_channels_have_their_labels_even_if_the_server_names_only_some(lab: RosLab) -> None:
    publisher = lab.source(given=parameters(channels=("Fx", "a,b")))
    lab.hear_all()
    publisher.publish(frame_of((ComponentType.ANALOG, [1.0, 2.0, -3.0])), stamp(), 0, ALL)
    wait_until(lambda: lab.received["/mocap/lab/analog"])
    array = lab.received["/mocap/lab/analog"][0].message
    assert array.layout.dim[0].label == "Fx,a_b,channel 3"
    assert array.data.tolist() == [1.0, 2.0, -3.0]


# Subscribers ---------------------------------------------------------------------------------


async def test_only_what_has_subscribers_is_encoded() -> None:
    with ros_lab() as lab:
        lab.open()
        publisher = lab.source(given=parameters(("wand",), markers=1))
        changes: list[bool] = []
        loop_thread = threading.current_thread()

        def on_change() -> None:
            assert threading.current_thread() is loop_thread
            changes.append(publisher.wants(ALL))

        assert lab.output.watch_wanted("lab", on_change)
        frame = frame_of((ComponentType.MARKERS, [(1, 2, 3, 0)]), ONE_TOOL)
        publisher.publish(frame, stamp(), 0, ALL)  # to nobody
        subscriber = await asyncio.to_thread(lab.hear, "mocap/lab/markers/**")
        await wait_until_async(lambda: changes == [True])
        publisher.publish(frame, stamp(), 1, ALL)
        await wait_until_async(lambda: lab.received["/mocap/lab/markers"])
        assert [each.sequence for each in lab.received["/mocap/lab/markers"]] == [1]
        subscriber.undeclare()
        await wait_until_async(lambda: changes == [True, False])
        assert set(lab.received) == {"/mocap/lab/markers"}


def test_a_subscriber_of_tf_wants_all_sources(lab: RosLab) -> None:
    publishers = [lab.source(name, parameters(("wand",))) for name in ("lab", "hall")]
    wait_until(lambda: "/mocap/hall/wand/pose" in lab.topics())
    lab.hear("tf/**")
    wait_until(lambda: all(publisher.wants(ALL) for publisher in publishers))
    for number, publisher in enumerate(publishers):
        publisher.publish(tools_frame((number, 0, 0)), stamp(), 0, ALL)
    wait_until(lambda: len(lab.received["/tf"]) == 2)
    assert [each.sequence for each in lab.received["/tf"]] == [1, 2]
    children = [each.message.transforms[0].child_frame_id for each in lab.received["/tf"]]
    assert children == ["lab/wand", "hall/wand"]


# Life cycle ----------------------------------------------------------------------------------


def test_without_a_router_frames_are_refused_and_health_says_what_to_do() -> None:
    with ros_lab() as lab:
        lab.cut()
        lab.output.start()
        publisher = lab.source(given=parameters(("wand",)))
        wait_until(lambda: "no Zenoh router" in lab.output.health().problem)
        assert "rmw_zenohd" in lab.output.health().problem
        assert lab.endpoint in lab.output.health().problem
        with pytest.raises(OutputError) as refused:
            publisher.publish(tools_frame((1, 2, 3)), stamp(), 0, ALL)
        assert refused.value.cause == "not open"
        lab.restore()
        wait_until(lab.is_connected)
        wait_until(lambda: "/mocap/lab/wand/pose" in lab.topics())


def test_when_the_router_comes_back_topics_and_messages_do_too(
    lab: RosLab, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    publisher = lab.source(given=parameters(("wand",)))
    lab.hear_all()
    lab.cut()
    wait_until(lambda: not lab.is_connected())
    with pytest.raises(OutputError) as refused:
        publisher.publish(tools_frame((1, 2, 3)), stamp(), 0, ALL)
    assert refused.value.cause == "no router"
    lab.restore()
    wait_until(lab.is_connected)

    def arrives() -> bool:
        publisher.publish(tools_frame((1, 2, 3)), stamp(), 1, ALL)
        return bool(lab.received["/mocap/lab/wand/pose"])

    wait_until(arrives)
    wait_until(lambda: "/mocap/lab/wand/pose" in lab.topics())
    texts = [each.getMessage() for each in caplog.records if each.levelno >= logging.INFO]
    assert any("is not connected any more" in text for text in texts)
    assert any("connected to the router" in text and "after" in text for text in texts)


def test_after_closing_the_node_is_gone(lab: RosLab) -> None:
    publisher = lab.source(given=parameters(("wand",)))
    wait_until(lambda: "/mocap/lab/wand/pose" in lab.topics())
    lab.output.close()
    lab.output.close()
    wait_until(lambda: not lab.tokens())
    with pytest.raises(OutputError) as refused:
        publisher.publish(tools_frame((1, 2, 3)), stamp(), 0, ALL)
    assert (refused.value.cause, str(refused.value)) == ("not open", lab.output.health().problem)
    publisher.close()
    lab.output.withdraw("lab")
    lab.output.maintain()
    assert not lab.output.health().connected
