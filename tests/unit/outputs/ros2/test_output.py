"""The output for ROS 2 with a real router: topics, messages, losses and life cycle."""

import asyncio
import json
import logging
import math
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import rtc3d
import zenoh

from gateway.errors import OutputError
from gateway.losses import Losses
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.topics import Topic
from gateway.outputs.ros2.message_types import TF_MESSAGE
from gateway.outputs.ros2.output import Ros2Output
from gateway.outputs.ros2.settings import Ros2Settings
from gateway.outputs.ros2.source_topics import MAX_PLATES, MAX_TOOLS, SourceTopics
from gateway.outputs.ros2.topic import RosTopic
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import ForceChannel, Plate
from tests import statuses
from tests.networks import zenoh_keys
from tests.ros_lab import ALL, UTIME, RosLab, frame_of, parameters, ros_lab, stamp, tools_frame
from tests.waiting import wait_until, wait_until_async

STAMP = (1_700_000_000, 1000)
"""Seconds and nanoseconds of UTIME."""


@pytest.fixture
def lab() -> Iterator[RosLab]:
    with ros_lab() as lab:
        yield lab.open()


def seconds(message: object) -> tuple[int, int]:
    time_stamp = message.header.stamp  # type: ignore[attr-defined]  # rosbags makes its types at run time
    return time_stamp.sec, time_stamp.nanosec


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


def test_items_that_the_parameters_lack_have_topics_before_anybody_subscribes(lab: RosLab) -> None:
    publisher = lab.source(given=parameters(markers=1))
    layout = frame_of((ComponentType.MARKERS, [(0, 0, 0, 0)]), *_one_tool()).layout
    assert not publisher.prepare(layout, frozenset({ComponentType.MARKERS}))
    assert not publisher.prepare(layout, ALL)
    assert not publisher.prepare(tools_frame((0, 0, 0), (0, 0, 0)).layout, ALL)
    wait_until(lambda: {"/mocap/lab/tool_1/pose", "/mocap/lab/tool_2/pose"} <= lab.topics())
    lab.output.publish_parameters("lab", parameters(("wand",), markers=1, version=2))
    wait_until(lambda: "/mocap/lab/wand/pose" in lab.topics())
    assert "/mocap/lab/tool_2/pose" not in lab.topics()
    assert not publisher.prepare(tools_frame((0, 0, 0), (0, 0, 0)).layout, ALL)
    wait_until(lambda: "/mocap/lab/tool_2/pose" in lab.topics())


def test_only_frames_with_a_component_that_somebody_subscribes_to_are_wanted(lab: RosLab) -> None:
    publisher = lab.source(given=parameters(("wand",), channels=("Fx",)))
    analog = frame_of((ComponentType.ANALOG, [1.0])).layout
    both = frame_of((ComponentType.ANALOG, [1.0]), *_one_tool()).layout
    lab.settle()
    lab.hear("tf/**")
    wait_until(lambda: publisher.wanted)
    assert not publisher.prepare(analog, ALL)
    assert publisher.prepare(both, ALL)
    assert not publisher.prepare(both, frozenset({ComponentType.ANALOG}))


def test_a_renamed_tool_has_a_new_topic_and_the_others_keep_their_numbers(lab: RosLab) -> None:
    publisher = lab.source(given=parameters(("wand", "cup")))
    lab.hear_all()
    publisher.publish(tools_frame((1, 2, 3), (1, 2, 3)), stamp(), 0, ALL)
    lab.output.publish_parameters("lab", parameters(("wand", "glass"), version=2))
    wait_until(lambda: "/mocap/lab/glass/pose" in lab.topics())
    assert "/mocap/lab/cup/pose" not in lab.topics()

    def arrived() -> bool:
        publisher.publish(tools_frame((1, 2, 3), (1, 2, 3)), stamp(), 1, ALL)
        return bool(lab.received["/mocap/lab/glass/pose"])

    wait_until(arrived)
    assert [each.sequence for each in lab.received["/mocap/lab/wand/pose"][:2]] == [1, 2]
    assert lab.received["/mocap/lab/glass/pose"][0].sequence == 1
    assert len(lab.received["/mocap/lab/cup/pose"]) == 1


def test_a_source_that_goes_takes_its_topics_with_it(lab: RosLab) -> None:
    publisher = lab.source(given=parameters(("wand",)))
    lab.source("hall-2", parameters(("wand",)))
    wait_until(lambda: {"/mocap/lab/wand/pose", "/mocap/hall_2/wand/pose"} <= lab.topics())
    publisher.close()
    lab.output.withdraw("lab")
    wait_until(lambda: "/mocap/lab/wand/pose" not in lab.topics())
    assert "/mocap/hall_2/wand/pose" in lab.topics()
    with pytest.raises(OutputError) as refused:
        publisher.publish(tools_frame((1, 2, 3)), stamp(), 0, ALL)
    assert refused.value.cause == "closed"
    lab.source(given=parameters(("wand",)))
    wait_until(lambda: "/mocap/lab/wand/pose" in lab.topics())


def test_sources_whose_names_ros_cannot_distinguish_get_different_ones(lab: RosLab) -> None:
    for name in ("1lab", "source_1lab", "-"):
        lab.source(name, parameters(markers=1))
    wait_until(lambda: len(lab.topics()) == 5)
    assert lab.topics() - {"/tf", "/diagnostics"} == {
        "/mocap/source_1lab/markers",
        "/mocap/source_1lab_2/markers",
        "/mocap/source/markers",
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


def test_nothing_is_published_while_all_tools_are_out_of_view(lab: RosLab) -> None:
    publisher = lab.source(given=parameters(("wand",), markers=1))
    lab.hear_all()
    publisher.publish(tools_frame(None), stamp(), 0, ALL)
    publisher.publish(frame_of((ComponentType.MARKERS, [(1, 2, 3, 0)])), stamp(), 1, ALL)
    wait_until(lambda: lab.received["/mocap/lab/markers"])
    assert set(lab.received) == {"/mocap/lab/markers"}


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


def test_forces_are_in_newtons_and_newton_metres(lab: RosLab) -> None:
    def plate(force: str, moment: str) -> Plate:
        units = [force] * 3 + [moment] * 3
        return Plate("1", channels=tuple(ForceChannel(str(n), unit=unit) for n, unit in enumerate(units)))

    plates = (plate("N", "Nmm"), plate("kN", "Nm"), plate("", ""))
    publisher = lab.source(given=parameters(plates=plates))
    lab.hear_all()
    load = (1.0, 2.0, 3.0, 4000.0, 0.0, 0.0)
    nan = (math.nan,) * 6
    publisher.publish(frame_of((ComponentType.FORCE, [load, load, nan])), stamp(), 0, ALL)
    publisher.publish(frame_of((ComponentType.FORCE, [load, load, load])), stamp(), 1, ALL)
    wait_until(lambda: lab.received["/mocap/lab/force_3/wrench"])
    found = [lab.received[f"/mocap/lab/force_{n}/wrench"][0].message.wrench for n in (1, 2, 3)]
    assert [(each.force.x, each.force.z, each.torque.x) for each in found] == [
        (1.0, 3.0, 4.0),
        (1000.0, 3000.0, 4000.0),
        (1.0, 3.0, 4000.0),
    ]
    assert len(lab.received["/mocap/lab/force_3/wrench"]) == 1  # not the missing load


def test_channels_have_their_labels_even_if_the_server_names_only_some(lab: RosLab) -> None:
    publisher = lab.source(given=parameters(channels=("Fx", "a,b")))
    lab.hear_all()
    publisher.publish(frame_of((ComponentType.ANALOG, [1.0, 2.0, -3.0])), stamp(), 0, ALL)
    wait_until(lambda: lab.received["/mocap/lab/analog"])
    array = lab.received["/mocap/lab/analog"][0].message
    assert array.layout.dim[0].label == "Fx,a_b,channel 3"
    assert array.data.tolist() == [1.0, 2.0, -3.0]


def test_only_the_given_components_are_published_and_each_as_often_as_it_occurs(lab: RosLab) -> None:
    publisher = lab.source(given=parameters(markers=1, channels=("Fx",)))
    lab.hear_all()
    frame = frame_of(
        (ComponentType.MARKERS, [(1, 2, 3, 0)]),
        (ComponentType.ANALOG, [1.0]),
        (ComponentType.EVENT, []),
        (ComponentType.MARKERS, [(4, 5, 6, 0), (7, 8, 9, 0)]),
    )
    publisher.publish(frame, stamp(), 0, frozenset({ComponentType.MARKERS}))
    wait_until(lambda: len(lab.received["/mocap/lab/markers"]) == 2)
    assert [each.message.width for each in lab.received["/mocap/lab/markers"]] == [1, 2]
    assert not lab.received["/mocap/lab/analog"]


def test_frames_of_no_and_of_fewer_items(lab: RosLab) -> None:
    publisher = lab.source(
        given=parameters(("wand", "cup"), markers=1, channels=("Fx",), plates=(Plate("1"),))
    )
    lab.hear_all()
    kinds = (ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.ANALOG, ComponentType.FORCE)
    publisher.publish(frame_of(*((kind, []) for kind in kinds)), stamp(), 0, ALL)
    publisher.publish(tools_frame((0, 0, 0)), stamp(), 1, ALL)
    wait_until(lambda: lab.received["/tf"])
    assert lab.received["/mocap/lab/markers"][0].message.width == 0
    assert lab.lost() == {}


def test_the_status_becomes_diagnostics(lab: RosLab) -> None:
    publisher = lab.output.publisher(Topic("lab", ("status",), "rtc3d.status_t"))
    assert not publisher.wanted
    lab.hear("diagnostics/**")
    wait_until(lambda: publisher.wanted)
    publisher.publish(example_status())
    wait_until(lambda: lab.received["/diagnostics"])
    array = lab.received["/diagnostics"][0].message
    assert seconds(array) == STAMP
    markers, analog, zenoh, frame = array.status
    assert (markers.level, markers.name, markers.message) == (0, "rtc3d_gateway: lab 3d 6d", "streaming")
    assert markers.hardware_id == "192.0.2.20:3020"
    assert {each.key: each.value for each in markers.values}["rate (Hz)"] == "200.0"
    assert (analog.level, analog.message) == (2, "waiting to reconnect: connection refused")
    assert (zenoh.level, zenoh.name, zenoh.message) == (2, "rtc3d_gateway: lab to zenoh", "start zenohd")
    assert {each.key: each.value for each in zenoh.values} == {"sent 3d": "7", "lost: no router": "12"}
    assert (frame.level, frame.name, frame.message) == (0, "rtc3d_gateway: lab coordinate frame", "hall")
    assert {each.key: each.value for each in frame.values} == {
        "metres per unit of the server": "0.001",
        "rotation (x y z w)": "0.5 0.5 0.5 0.5",
        "translation (m)": "2.5 0.0 -1.0",
    }
    publisher.close()
    with pytest.raises(OutputError, match="closed"):
        publisher.publish(example_status())


def example_status() -> bytes:
    status = rtc3d.status_t()
    status.utime = UTIME
    status.source, status.server = "lab", "192.0.2.20:3020"
    status.frame_id, status.metres_per_unit = "hall", 0.001
    status.rotation_xyzw, status.translation_m = [0.5, 0.5, 0.5, 0.5], [2.5, 0.0, -1.0]
    status.streams = [
        statuses.stream("3d 6d", frame_rate_hz=200.0),
        statuses.stream("analog", state="waiting to reconnect", last_error="connection refused"),
    ]
    status.num_streams = 2
    status.outputs = [
        statuses.output(
            connected=False,
            problem="start zenohd",
            num_messages=1,
            messages=[statuses.count("3d", 7)],
            num_drops=1,
            drops=[statuses.loss("no router", 12, 12)],
        )
    ]
    status.num_outputs = 1
    encoded: bytes = status.encode()
    return encoded


def test_the_clock_is_not_for_ros(lab: RosLab) -> None:
    publisher = lab.output.publisher(Topic("lab", ("clock",), "rtc3d.clock_t"))
    publisher.publish(b"anything")
    assert not publisher.wanted


# Subscribers ---------------------------------------------------------------------------------


async def test_only_what_has_subscribers_is_encoded() -> None:
    with ros_lab() as lab:
        lab.open()
        publisher = lab.source(given=parameters(("wand",), markers=1))
        changes: list[bool] = []
        loop_thread = threading.current_thread()

        def on_change() -> None:
            assert threading.current_thread() is loop_thread
            changes.append(publisher.wanted)

        assert lab.output.watch_wanted("lab", on_change)
        frame = frame_of((ComponentType.MARKERS, [(1, 2, 3, 0)]), *_one_tool())
        publisher.publish(frame, stamp(), 0, ALL)  # to nobody
        subscriber = await asyncio.to_thread(lab.hear, "mocap/lab/markers/**")
        await wait_until_async(lambda: changes == [True])
        publisher.publish(frame, stamp(), 1, ALL)
        await wait_until_async(lambda: lab.received["/mocap/lab/markers"])
        assert [each.sequence for each in lab.received["/mocap/lab/markers"]] == [1]
        subscriber.undeclare()
        await wait_until_async(lambda: changes == [True, False])
        assert set(lab.received) == {"/mocap/lab/markers"}


def _one_tool() -> list[tuple[ComponentType, list[object]]]:
    return [(ComponentType.TOOLS, [(1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 0.0)])]


def test_a_subscriber_of_tf_wants_all_sources(lab: RosLab) -> None:
    publishers = [lab.source(name, parameters(("wand",))) for name in ("lab", "hall")]
    wait_until(lambda: "/mocap/hall/wand/pose" in lab.topics())
    lab.hear("tf/**")
    wait_until(lambda: all(publisher.wanted for publisher in publishers))
    for number, publisher in enumerate(publishers):
        publisher.publish(tools_frame((number, 0, 0)), stamp(), 0, ALL)
    wait_until(lambda: len(lab.received["/tf"]) == 2)
    assert [each.sequence for each in lab.received["/tf"]] == [1, 2]
    children = [each.message.transforms[0].child_frame_id for each in lab.received["/tf"]]
    assert children == ["lab/wand", "hall/wand"]


# Losses --------------------------------------------------------------------------------------


def test_an_unknown_unit_publishes_no_positions_and_is_counted(lab: RosLab) -> None:
    frame = CoordinateFrame("lab", None)
    given = parameters(("wand",), markers=1, channels=("Fx",), unit="furlong", frame=frame)
    publisher = lab.source(given=given)
    lab.hear_all()
    kinds = frame_of((ComponentType.MARKERS, [(1, 2, 3, 0)]), *_one_tool(), (ComponentType.ANALOG, [1.0]))
    publisher.publish(kinds, stamp(), 0, ALL)
    wait_until(lambda: lab.received["/mocap/lab/analog"])
    assert set(lab.received) == {"/mocap/lab/analog"}
    assert lab.lost() == {"unknown unit": 3}  # the cloud, the pose, /tf
    assert "furlong" in lab.losses["lab"].report()[0].text


def test_thousands_of_labels_and_plates_are_bounded_and_counted(lab: RosLab) -> None:
    tools = tuple(f"tool {number}" for number in range(3000))
    plates = tuple(Plate(str(number)) for number in range(1000))
    publisher = lab.source(given=parameters(tools, plates=plates))
    wait_until(lambda: len(lab.topics()) == 2 + MAX_TOOLS + MAX_PLATES)
    lab.hear_all()
    publisher.publish(tools_frame(*[(1, 2, 3)] * 3000), stamp(), 0, ALL)
    publisher.publish(frame_of((ComponentType.FORCE, [(1, 2, 3, 4, 5, 6)] * 1000)), stamp(), 1, ALL)
    wait_until(lambda: len(lab.received) == 1 + MAX_TOOLS + MAX_PLATES)
    assert len(lab.received["/tf"][0].message.transforms) == MAX_TOOLS
    assert lab.lost() == {"too many tools": 3000 - MAX_TOOLS, "too many force plates": 1000 - MAX_PLATES}


def test_items_whose_topics_are_not_open_yet_are_not_too_many() -> None:
    tf = RosTopic("/tf", TF_MESSAGE, lambda: None)
    topics = SourceTopics("lab", "/mocap/lab", tf, lambda: None)
    topics.losses = Losses(logging.getLogger("tests"), "lab to ros2")
    tf.wanted = True
    topics.send(tools_frame((1, 2, 3), (4, 5, 6)), stamp(), ALL, parameters(("wand",)))
    assert topics.losses.report() == []


def stalled(lab: RosLab) -> threading.Event:
    """Let the sending thread wait for the event that is returned."""
    may_go_on = threading.Event()

    def wait() -> None:
        may_go_on.wait(10)

    lab.output.submit(wait)
    return may_go_on


def test_frames_beyond_the_queue_are_refused_and_ros_sees_the_gap(lab: RosLab) -> None:
    publisher = lab.source(given=parameters(markers=1, channels=("Fx",)))
    lab.hear_all()
    frame = frame_of((ComponentType.MARKERS, [(1, 2, 3, 0)]), (ComponentType.ANALOG, [1.0]))
    publisher.publish(frame, stamp(), 0, ALL)
    may_go_on = stalled(lab)
    while lab.output.offer(lambda: None):
        pass
    for number in range(3):
        with pytest.raises(OutputError) as refused:
            publisher.publish(frame, stamp(), number, frozenset({ComponentType.MARKERS}))
        assert refused.value.cause == "queue full"
    may_go_on.set()
    wait_until(lambda: lab.output.offer(lambda: None))
    publisher.publish(frame, stamp(), 4, ALL)
    wait_until(lambda: len(lab.received["/mocap/lab/analog"]) == 2)
    assert [each.sequence for each in lab.received["/mocap/lab/markers"]] == [1, 5]
    assert [each.sequence for each in lab.received["/mocap/lab/analog"]] == [1, 2]


def test_frames_that_wait_when_the_router_goes_are_counted(lab: RosLab) -> None:
    publisher = lab.source(given=parameters(markers=1))
    lab.hear_all()
    may_go_on = stalled(lab)
    for number in range(3):
        publisher.publish(frame_of((ComponentType.MARKERS, [(1, 2, 3, 0)])), stamp(), number, ALL)
    lab.cut()
    wait_until(lambda: not lab.is_connected())
    may_go_on.set()
    wait_until(lambda: lab.lost() == {"no router": 3})


def test_a_router_that_stops_reading_for_a_moment_loses_nothing() -> None:
    with ros_lab() as lab, stoppable_router(lab) as router:
        lab.open()
        publisher = lab.source(given=parameters(markers=10_000))
        wait_until(lambda: publisher.wanted)
        router.send_signal(signal.SIGSTOP)
        large = frame_of((ComponentType.MARKERS, [(1, 2, 3, 0)] * 10_000))
        for number in range(_LARGE_FRAMES):
            publisher.publish(large, stamp(), number, ALL)
        time.sleep(0.3)  # the pause
        router.send_signal(signal.SIGCONT)
        assert router.stdout is not None
        assert router.stdout.readline().split() == [str(n + 1).encode() for n in range(_LARGE_FRAMES)]


_LARGE_FRAMES = 100
"""Clouds of 200 kB: more than the buffers of the connection hold."""

_ROUTER = """
import struct, sys, zenoh

with zenoh.open(zenoh.Config.from_json5(sys.argv[1])) as session:
    subscriber = session.declare_subscriber("0/mocap/lab/markers/**")
    for _ in range(int(sys.argv[2])):
        attachment = subscriber.recv().attachment.to_bytes()
        print(struct.unpack_from("<q", attachment)[0], end=" ")
    print(flush=True)
"""
"""A router that prints the numbers of the first clouds, and ends."""


@contextmanager
def stoppable_router(lab: RosLab) -> Iterator[subprocess.Popen[bytes]]:
    """Replace the lab's router by a process that subscribes to the markers."""
    lab.cut()
    keys = json.dumps(zenoh_keys("router", listen=lab.endpoint))
    command = [sys.executable, "-c", _ROUTER, keys, str(_LARGE_FRAMES)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.kill()


def test_a_defect_is_logged_once_and_counted_and_the_next_frame_is_published(
    lab: RosLab, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    publisher = lab.source(given=parameters(("wand",)))
    lab.hear_all()
    with monkeypatch.context() as patch:
        patch.setattr("gateway.outputs.ros2.source_topics.pack_pose", lambda *_values: 1 // 0)
        for _ in range(3):
            publisher.publish(tools_frame((1, 2, 3)), stamp(), 0, ALL)
        wait_until(lambda: lab.lost() == {"ZeroDivisionError": 3})
    publisher.publish(tools_frame((1, 2, 3)), stamp(), 1, ALL)
    wait_until(lambda: lab.received["/tf"])
    errors = [each.message for each in caplog.records if each.levelno == logging.ERROR]
    assert len(errors) == 1
    assert "ZeroDivisionError" in errors[0]


def test_what_zenoh_refuses_is_counted_and_no_defect(
    lab: RosLab, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(_cdr: bytes, _now_ns: int) -> None:
        raise zenoh.ZError("no")

    publisher = lab.source(given=parameters(("wand",)))
    lab.hear_all()
    monkeypatch.setattr(lab.output._tf, "put", refuse)
    publisher.publish(tools_frame((1, 2, 3)), stamp(), 0, ALL)
    wait_until(lambda: lab.lost() == {"put failed": 1})
    assert not [each for each in caplog.records if each.levelno >= logging.ERROR]


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


def test_an_output_that_was_never_started_has_no_threads_and_can_be_closed() -> None:
    before = threading.active_count()
    output = Ros2Output(Ros2Settings(enabled=True))
    publisher = output.frame_publisher("lab")
    output.publish_parameters("lab", parameters(("wand",)))
    assert threading.active_count() == before
    with pytest.raises(OutputError):
        publisher.publish(tools_frame((1, 2, 3)), stamp(), 0, ALL)
    output.close()
    output.close()
    assert not output.health().connected


def test_a_reload_keeps_an_output_with_the_same_settings() -> None:
    output = Ros2Output(Ros2Settings(enabled=True))
    assert output.is_configured_like(Ros2Output(Ros2Settings(enabled=True)))
    assert not output.is_configured_like(Ros2Output(Ros2Settings(enabled=True, domain_id=1)))
    assert not output.take_over(Ros2Output(Ros2Settings(enabled=True)))
