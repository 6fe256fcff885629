"""Export to a bag of ROS 2, read by the package ``rosbags``."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rtc3d
from rosbags.highlevel import AnyReader

from gateway.errors import SelectionError, TakeError
from gateway.messages.topics import lcm_channel
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import (
    EventDefinition,
    EventParameter,
    ForceChannel,
    Parameters,
    Parameters6D,
    ParametersEvents,
    ParametersForce,
    Plate,
    Tool,
)
from gateway.simulator.synthetic import SyntheticScene
from gateway.takes import open_take
from gateway.takes.export.job import ExportJob, export_take
from tests.support.documents import ROOT
from tests.support.errors import each_names, one_names, raises
from tests.support.takes import START_UTIME, Message, frame, parameters, scene_messages
from tests.unit.takes.export.exported import NAN, export_messages, labelled, notes_of

SCENE = SyntheticScene(markers=3, tools=2, analog=3, plates=2, rate_hz=100, analog_rate_hz=200)
TYPES = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/mocap/lab/labels": "diagnostic_msgs/msg/DiagnosticArray",
    "/mocap/lab/markers": "sensor_msgs/msg/PointCloud2",
    "/mocap/lab/Tool_1/pose": "geometry_msgs/msg/PoseStamped",
    "/mocap/lab/Tool_2/pose": "geometry_msgs/msg/PoseStamped",
    "/mocap/lab/analog": "std_msgs/msg/Float32MultiArray",
    "/mocap/lab/force_1/wrench": "geometry_msgs/msg/WrenchStamped",
    "/mocap/lab/force_2/wrench": "geometry_msgs/msg/WrenchStamped",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/mocap/lab/force_1/centre_of_pressure": "geometry_msgs/msg/PointStamped",
    "/mocap/lab/force_2/centre_of_pressure": "geometry_msgs/msg/PointStamped",
}


class Bag:
    """What rosbags reads: the type of each topic, and its messages with their times in ns."""

    def __init__(self, path: Path) -> None:
        self.messages: defaultdict[str, list[tuple[int, Any]]] = defaultdict(list)
        with AnyReader([path]) as reader:
            self.types = {each.topic: each.msgtype for each in reader.connections}
            for connection, time_ns, raw in reader.messages():
                message = reader.deserialize(raw, connection.msgtype)
                self.messages[connection.topic].append((time_ns, message))


def export(folder: Path, *messages: Any, **options: Any) -> tuple[Bag, ExportJob]:
    job = export_messages(folder, messages, "out.mcap", format="ros2", **options)
    return Bag(folder / "out.mcap"), job


def triple(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def test_a_bag_has_the_values_of_the_take_in_the_units_of_ros(tmp_path: Path) -> None:
    bag, job = export(tmp_path, parameters(SCENE.parameters), *scene_messages(SCENE, 20))
    lab = open_take(tmp_path / "take.lcmlog").sources["lab"]
    assert bag.types == TYPES
    assert lab.markers is not None
    assert lab.tools is not None
    assert lab.analog is not None
    assert lab.forces is not None
    clouds = bag.messages["/mocap/lab/markers"]
    points = np.stack([np.frombuffer(cloud.data, "<f4").reshape(-1, 5)[:, :3] for _, cloud in clouds])
    assert np.allclose(points, lab.markers.positions / 1000, rtol=1e-6, equal_nan=True)
    assert [time_ns for time_ns, _ in clouds] == (1000 * lab.markers.capture_utime).tolist()
    stamps = [message.header.stamp for _, message in clouds]
    assert [10**9 * stamp.sec + stamp.nanosec for stamp in stamps] == [time_ns for time_ns, _ in clouds]
    poses = [message.pose for _, message in bag.messages["/mocap/lab/Tool_2/pose"]]
    is_visible = lab.tools.is_visible[:, 1]
    assert np.allclose([triple(pose.position) for pose in poses], lab.tools.positions[is_visible, 1] / 1000)
    turned = [(*triple(pose.orientation), pose.orientation.w) for pose in poses]
    assert np.allclose(turned, lab.tools.quaternions_xyzw[is_visible, 1])
    transforms = [message.transforms for _, message in bag.messages["/tf"]]
    assert [len(each) for each in transforms] == lab.tools.is_visible.sum(axis=1).tolist()
    names = [(each.header.frame_id, each.child_frame_id) for each in transforms[0]]
    assert names == [("lab", "lab/Tool_1"), ("lab", "lab/Tool_2")]
    assert np.array_equal(
        [message.data for _, message in bag.messages["/mocap/lab/analog"]], lab.analog.values
    )
    loads = [message.wrench for _, message in bag.messages["/mocap/lab/force_2/wrench"]]
    values = [(*triple(load.force), *triple(load.torque)) for load in loads]
    plates = SCENE.parameters.force
    assert plates is not None
    factors = [1.0] * 3 + [1e-3 if plates.plates[1].channels[3].unit == "Nmm" else 1.0] * 3
    assert np.allclose(values, lab.forces.values[:, 1] * factors)
    assert notes_of(job) == []
    assert one_names(notes_of(job, usual=True), "labels of tools", "lab", "Tool_1")


def test_loads_act_at_the_centre_of_pressure_in_the_frame_of_their_plate(tmp_path: Path) -> None:
    """A person walks: moved there by /tf_static, each load has no moment but the one about the vertical."""
    source = open_take(ROOT / "examples/walk.lcmlog").sources["lab"]
    export_take(ExportJob(ROOT / "examples/walk.lcmlog", tmp_path / "walk.mcap", "ros2"))
    bag = Bag(tmp_path / "walk.mcap")
    [(_, static)] = bag.messages["/tf_static"]
    origins = {
        each.child_frame_id: np.array(triple(each.transform.translation)) for each in static.transforms
    }
    assert source.forces is not None
    for number in (1, 2):
        loads = dict(bag.messages[f"/mocap/lab/force_{number}/wrench"])
        centres = bag.messages[f"/mocap/lab/force_{number}/centre_of_pressure"]
        assert 100 < len(centres) < len(loads)
        for time_ns, centre in centres:
            load = loads[time_ns]
            force, moment = (np.array(triple(each)) for each in (load.wrench.force, load.wrench.torque))
            arm = np.array(triple(centre.point)) - origins[load.header.frame_id]
            about_centre = moment - np.cross(arm, force)
            assert abs(about_centre[:2]).max() < 1e-3 * abs(force[2])  # N at an arm of 1 mm
            assert abs(arm[2]) < 1e-9
            assert abs(arm[:2]).max() < 0.35  # on the plate


def test_the_newest_labels_of_a_bag_are_those_of_all_components(tmp_path: Path) -> None:
    """They are there before the first message that needs them, and again when they change."""
    first, renamed = labelled("a", "b"), labelled("a", "c", version=2)
    values = [(1.0, 2.0, 3.0, 0.0)] * 2
    bag, _ = export(
        *(tmp_path, first),
        *(frame(ComponentType.MARKERS, values, n) for n in range(2)),
        frame(ComponentType.TOOLS, [(1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 0.0)], 1),
        renamed,
        frame(ComponentType.MARKERS, values, 200, version=2),
        labelled("a", "c", unit="cm", version=3),
        frame(ComponentType.MARKERS, values, 300, version=3),
    )
    found = [
        (time_ns, {each.name: {pair.key: pair.value for pair in each.values} for each in message.status})
        for time_ns, message in bag.messages["/mocap/lab/labels"]
    ]
    tools = {"tools": {"tool_1": "tool 1"}}
    assert [labels for _, labels in found] == [
        {"markers": {"0": "a", "1": "b"}},
        {"markers": {"0": "a", "1": "b"}} | tools,
        {"markers": {"0": "a", "1": "c"}} | tools,
    ]
    clouds = [time_ns for time_ns, _ in bag.messages["/mocap/lab/markers"]]
    assert [time_ns for time_ns, _ in found][::2] == clouds[:3:2]


def test_events_have_their_own_times_names_and_parameters(tmp_path: Path) -> None:
    """The label is that of the parameters at the time; an event may be a message after its frame's time."""
    named = EventDefinition("7", "Left foot strike", parameters=(EventParameter("1", "int", "Side"),))
    described = parameters(Parameters(events=ParametersEvents((named,))))
    early, odd = (7, 995_000, 2, -1, -1), (8, -5_000_000, -1, -1, 3)
    bag, _ = export(
        tmp_path, described, frame(ComponentType.EVENT, [early, odd], 100, timestamp_us=1_000_000)
    )
    assert [*bag.types] == ["/mocap/lab/events"]
    found = bag.messages["/mocap/lab/events"]
    (first_ns, first), (second_ns, second) = found
    assert second_ns - first_ns == 5_000_000  # the time stamp of the other one is implausible
    for time_ns, message in found:
        assert 10**9 * message.header.stamp.sec + message.header.stamp.nanosec == time_ns
    [[status], [unknown]] = first.status, second.status
    values = {pair.key: pair.value for pair in status.values}
    assert (status.name, status.hardware_id, values) == ("Left foot strike", "lab", {"id": "7", "Side": "2"})
    assert (unknown.name, unknown.message) == ("event 8", "param3: 3")


def test_what_is_missing_is_in_no_message_or_nan(tmp_path: Path) -> None:
    tools = Parameters(tools=Parameters6D(100.0, tuple(Tool(str(n), f"t{n}") for n in range(2))))
    seen, lost = (1.0, 0.0, 0.0, 0.0, 10.0, 20.0, 30.0, 0.5), (NAN,) * 8
    messages = [
        frame(ComponentType.TOOLS, [seen, lost], 0),
        frame(ComponentType.TOOLS, [lost, lost], 1),
        frame(ComponentType.MARKERS, [(1.0, 2.0, 3.0, 0.0), (NAN, 2.0, 3.0, 0.0)], 0),
        frame(ComponentType.FORCE, [(1.0, 2.0, 3.0, 4.0, 5.0, NAN)], 0),
        frame(ComponentType.ANALOG, [1.0], 0, utime=-START_UTIME),
    ]
    bag, job = export(tmp_path, parameters(tools), *messages)
    assert {topic: len(found) for topic, found in bag.messages.items()} == {
        "/mocap/lab/labels": 2,
        "/mocap/lab/t0/pose": 1,
        "/tf": 1,
        "/mocap/lab/markers": 1,
    }
    points = np.frombuffer(bag.messages["/mocap/lab/markers"][0][1].data, "<f4").reshape(-1, 5)
    assert np.array_equal(points[:, 0], np.array([1e-3, NAN], np.float32), equal_nan=True)
    assert each_names(
        notes_of(job),
        ["NaN of lab", 1],
        ["1970", "2106", "analog", "lab", 1],
        ["rows", "6d", "lab", "1 of 2"],
        ["rows", "force", "lab", "1 of 1"],
        ["rows", "analog", "lab", "1 of 1"],
    )


def test_units_of_plates_are_converted_and_unknown_lengths_left_out(tmp_path: Path) -> None:
    units = ("kN", "kN", "kN", "Nmm", "Nmm", "Nmm")
    channels = tuple(ForceChannel(str(n), f"c{n}", unit) for n, unit in enumerate(units))
    plate = Parameters(force=ParametersForce((Plate("1", channels=channels),)))
    load = frame(ComponentType.FORCE, [(1.0, 2.0, 3.0, 4.0, 5.0, 6.0)], 0)
    bag, job = export(tmp_path, parameters(plate), load)
    assert each_names(notes_of(job), ["forces", "N.m"])
    [(_, message)] = bag.messages["/mocap/lab/force_1/wrench"]
    assert triple(message.wrench.force) == (1000.0, 2000.0, 3000.0)
    assert triple(message.wrench.torque) == pytest.approx((4e-3, 5e-3, 6e-3))
    (tmp_path / "out.mcap").unlink()
    _, job = export(
        tmp_path, labelled("a", unit="furlong"), frame(ComponentType.MARKERS, [(1, 2, 3, 0)]), load
    )
    assert one_names(notes_of(job), "markers", "'furlong'", "lab", 1)


def test_a_bag_of_another_format_or_of_nothing_is_refused(tmp_path: Path) -> None:
    with raises(SelectionError, "out.c3d", ".mcap"):
        export_messages(tmp_path, [labelled("a")], "out.c3d", format="ros2")
    with raises(TakeError, "markers, tools, analog channels, forces or events"):
        export_messages(tmp_path, [labelled("a")], "out.mcap", format="ros2")
    assert not (tmp_path / "out.mcap").exists()


def test_the_frame_and_the_transform_are_those_of_the_newest_status(tmp_path: Path) -> None:
    """A bag has what the output published live, with x and y turned, moved and twice as large."""
    turned = (0.0, 0.0, 0.5**0.5, 0.5**0.5)
    statuses = [status("old", (0.0, 0.0, 0.0, 1.0), 1e-3), status("world", turned, 2e-3)]
    bag, _ = export(tmp_path, *statuses, parameters(SCENE.parameters), *scene_messages(SCENE, 20))
    lab = open_take(tmp_path / "take.lcmlog").sources["lab"]
    assert lab.markers is not None
    assert lab.forces is not None
    _, cloud = bag.messages["/mocap/lab/markers"][0]
    x, y, z = np.frombuffer(cloud.data, "<f4").reshape(-1, 5)[:, :3].T
    expected = lab.markers.positions[0].T / 500
    for found, values in zip((x, y, z), (1 - expected[1], 2 + expected[0], 3 + expected[2]), strict=True):
        assert np.allclose(found, values, rtol=1e-5, atol=1e-5, equal_nan=True)
    _, wrench = bag.messages["/mocap/lab/force_1/wrench"][0]
    fx, fy, fz = lab.forces.values[0, 0, :3]
    assert np.allclose(triple(wrench.wrench.force), (-fy, fx, fz), atol=1e-4)
    _, pose = bag.messages["/mocap/lab/Tool_1/pose"][0]
    assert {cloud.header.frame_id, pose.header.frame_id} == {"world"}
    assert wrench.header.frame_id == "lab/force_1"


def status(
    frame_id: str,
    rotation: tuple[float, ...],
    metres_per_unit: float,
    translation: tuple[float, ...] = (1.0, 2.0, 3.0),
) -> Message:
    """Return a ``status_t`` whose frame is turned and moved."""
    message = rtc3d.status_t()
    message.utime, message.source, message.server = START_UTIME, "lab", "192.0.2.20:3020"
    message.frame_id, message.metres_per_unit = frame_id, metres_per_unit
    message.rotation_xyzw, message.translation_m = [*rotation], [*translation]
    return lcm_channel("MOCAP", "lab", "status"), message.encode()
