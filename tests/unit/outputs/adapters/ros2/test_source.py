"""A source on ROS 2 without Zenoh: its topics, what is wanted, its messages and their numbers."""

import math
import struct
import time
from itertools import pairwise
from unittest.mock import Mock

import numpy as np
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.ros2.labels import MAX_LABELS
from gateway.outputs.adapters.ros2.source_topics import MAX_EVENTS, MAX_PLATES, MAX_TOOLS
from gateway.rtc3d.components import SHORT_EVENT, WIRE_ORDER, ByteOrder, ComponentType, encode_component
from gateway.rtc3d.frames import encode_frame, split_frame
from gateway.rtc3d.parameters import EventDefinition, ForceChannel, Plate, Point
from tests.support import ros_messages as ros
from tests.support.ros_lab import ALL, ONE_TOOL, UTIME, frame_of, parameters, stamp, tools_frame
from tests.unit.outputs.adapters.ros2.scripted_ros import Source, cause_of

MARKERS, TOOLS, ANALOG, FORCE, EVENT = WIRE_ORDER
LOAD = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
NAN = float("nan")
ONE_MARKER = frame_of((MARKERS, [(1, 2, 3, 0)]))
ONE_OF_EACH = frame_of((MARKERS, [(1, 2, 3, 0)]), ONE_TOOL, (ANALOG, [1.0]), (FORCE, [LOAD]))
TWO_TOOLS = tools_frame((1, 2, 3), (1, 2, 3))
EACH = parameters(("wand",), markers=1, channels=("Fx",), plates=(Plate("1"),))


# Which topics are open ----------------------------------------------------------------------


def test_parameters_open_and_close_topics_and_keep_those_that_stay() -> None:
    """A node that subscribes to a topic that stays must notice nothing."""
    source = Source(parameters(("wand", "cup"), markers=1))
    assert source.node.open == {"/tf", "/mocap/lab/wand/pose", "/mocap/lab/cup/pose", "/mocap/lab/markers"}
    source.subscribe()
    source.send(TWO_TOOLS)
    source.node.events.clear()
    source.use(parameters(("wand", "glass"), markers=1, version=2))
    assert sorted(source.node.events) == ["+/mocap/lab/glass/pose", "-/mocap/lab/cup/pose"]
    source.send(TWO_TOOLS)
    assert source.sent["wand/pose"] == [1, 2]
    source.send(TWO_TOOLS)
    assert len(source.node.events) == 2  # the same parameters change nothing


def test_topics_that_belong_to_parameters_from_before_the_session_are_declared_with_it() -> None:
    """The router may come later than the parameters."""
    source = Source(is_declared=False)
    source.sender.is_full = True
    source.publisher.set_parameters(EACH)
    for _ in range(2):
        source.declare()
        assert (len(source.node.open), len(source.node.events)) == (5, 6)  # with that of labels


def test_items_beyond_the_parameters_get_topics_before_they_are_wanted() -> None:
    """Nobody could subscribe otherwise; a layout that opens nothing costs the thread nothing."""
    source = Source(parameters(("wand",)))
    num_calls = len(source.sender.offered_bytes)
    two, one = TWO_TOOLS.layout, tools_frame((0, 0, 0)).layout
    assert not source.publisher.prepare(two, frozenset({MARKERS}))
    source.sender.is_full = True
    assert not source.publisher.prepare(two, ALL)
    source.sender.is_full = False
    for layout in (one, two, two, one):
        assert not source.publisher.prepare(layout, ALL)
        source.sender.run()
    assert len(source.sender.offered_bytes) == num_calls + 2
    source.subscribe()
    source.send(TWO_TOOLS)
    assert source.sent == {"wand/pose": [1], "tool_2/pose": [1], "/tf": [1]}
    assert source.node.open == {"/tf", "/mocap/lab/wand/pose", "/mocap/lab/tool_2/pose"}
    source.subscribe(is_there=False)
    source.publisher.set_parameters(parameters(("cup",), version=2))
    source.publisher.prepare(two, ALL)
    source.sender.run()
    assert source.node.open == {"/tf", "/mocap/lab/cup/pose", "/mocap/lab/tool_2/pose"}


def test_frames_and_their_items_use_the_parameters_that_were_valid_when_they_came() -> None:
    """Even if the queue was full when they changed."""
    for is_prepared, others in ((False, set[str]()), (True, {"/mocap/lab/tool_2/pose"})):
        source = Source(parameters(("wand",)))
        source.sender.is_full = True
        source.publisher.set_parameters(parameters(("cup",), version=2))
        source.sender.is_full = False
        if is_prepared:
            source.publisher.prepare(TWO_TOOLS.layout, ALL)
            source.sender.run()
        else:
            source.send(tools_frame((1, 2, 3)))
        assert source.node.open == {"/tf", "/mocap/lab/cup/pose"} | others


def test_thousands_of_items_are_bounded_and_counted() -> None:
    """The server determines how many there are; just as many as fit are no loss."""
    plates = tuple(Plate(str(number)) for number in range(MAX_PLATES + 1))
    source = Source(parameters(tuple(f"tool {number}" for number in range(MAX_TOOLS + 1)), plates=plates))
    assert len(source.node.open) == 1 + MAX_TOOLS + MAX_PLATES
    source.subscribe()
    for beyond, lost in (((0, 0), {}), ((3, 5), {"too many tools": (3, 1), "too many force plates": (5, 1)})):
        source.send(tools_frame(*[(1, 2, 3)] * (MAX_TOOLS + beyond[0])))
        source.send(frame_of((FORCE, [LOAD] * (MAX_PLATES + beyond[1]))))
        assert source.lost == lost
    assert len(source.sent) == 1 + MAX_TOOLS + MAX_PLATES


def test_names_that_differ_from_labels_are_shown() -> None:
    """Nodes look for labels; those that are valid names need no explanation."""
    source = Source(parameters(("wand", "Left Foot"), plates=(Plate("1", "left"), Plate("2"))))
    names = {"6d": {"Left Foot": "Left_Foot"}, "force": {"left": "force_1", "plate 2": "force_2"}}
    assert source.publisher.names == names
    source.use(parameters(("wand",), version=2))
    assert source.publisher.names == {"6d": {}}


def test_tools_have_the_names_and_frames_of_the_settings_and_some_are_left_out() -> None:
    """The items of a frame stay in their order, even those without topics."""
    chosen = {
        "wand": {"name": "hand", "child_frame": "hand_link"},
        "cup": False,
        "gone": {"name": "Left_Foot"},
    }
    source = Source(parameters(("cup", "wand", "Left Foot", "hand")), tools=chosen)
    names = ("hand", "Left_Foot_2", "hand_2")
    assert source.node.open == {"/tf", *(f"/mocap/lab/{name}/pose" for name in names)}
    assert source.publisher.names == {"6d": {"wand": "hand", "Left Foot": "Left_Foot_2", "hand": "hand_2"}}
    source.subscribe()
    source.send(tools_frame((1, 0, 0), (2, 0, 0), None, (4, 0, 0), (5, 0, 0)))
    moved = source.message("/tf", "tf2_msgs/msg/TFMessage").transforms
    assert {each.child_frame_id: each.transform.translation.x for each in moved} == {
        "hand_link": 0.002,
        "lab/hand_2": 0.004,
    }
    pose = source.message("hand/pose", "geometry_msgs/msg/PoseStamped").pose
    assert pose.position.x == 0.002
    source.publisher.prepare(tools_frame(*[(0, 0, 0)] * 5).layout, ALL)
    source.sender.run()
    assert "/mocap/lab/tool_5/pose" in source.node.open


def test_an_offset_is_in_the_frame_of_the_tool() -> None:
    """A marker cluster sits on a robot's hand: 0.1 m in x from its flange, and a quarter turn about z.

    The tool is turned by 90° about x: its y is the z of the source. Its quaternion is not quite normal.
    """
    half = math.sqrt(0.5)
    offset = {"translation_m": [0.1, 0.2, 0.0], "rotation_deg": {"yaw": 90}}
    source = Source(parameters(("wand", "cup")), tools={"wand": {"offset": offset}})
    source.subscribe()
    item = (1.01 * half, 1.01 * half, 0.0, 0.0, 1000.0, 0.0, 0.0, 0.1)
    source.send(frame_of((TOOLS, [item, item])))
    [moved, kept] = source.message("/tf", "tf2_msgs/msg/TFMessage").transforms
    pose = source.message("wand/pose", "geometry_msgs/msg/PoseStamped").pose
    for p, q in ((pose.position, pose.orientation), (moved.transform.translation, moved.transform.rotation)):
        assert (p.x, p.y, p.z) == pytest.approx((1.1, 0.0, 0.2), abs=1e-6)
        assert (q.x, q.y, q.z, q.w) == pytest.approx((0.505, -0.505, 0.505, 0.505), abs=1e-6)
    assert kept.transform.translation.x == 1.0


# What is wanted -----------------------------------------------------------------------------


def test_frames_are_wanted_if_any_of_their_components_has_a_subscriber() -> None:
    """Each change is reported once, because the gateway's stream depends on it."""
    source = Source(EACH)
    source.num_changes = 0
    source.subscribe("/mocap/lab/markers")
    source.subscribe("/mocap/lab/markers")
    assert source.num_changes == 1
    assert source.publisher.wants([MARKERS, TOOLS])
    assert not source.publisher.wants([TOOLS, FORCE, ANALOG])
    assert source.publisher.prepare(ONE_OF_EACH.layout, ALL)
    assert not source.publisher.prepare(ONE_OF_EACH.layout, frozenset({TOOLS}))
    source.subscribe("/tf")
    assert source.publisher.wants([TOOLS])
    source.subscribe("/mocap/lab/markers", is_there=False)
    assert not source.publisher.wants([MARKERS])
    source.publisher.update_wanted()
    assert source.num_changes == 3


def test_a_subscriber_that_came_before_its_topic_is_noticed() -> None:
    """By the topic itself, and by the check that is made again and again."""
    source = Source()
    source.node.matching.add("/mocap/lab/markers")
    source.publisher.set_parameters(parameters(markers=1))
    source.num_changes = 0
    source.sender.run()
    assert not source.publisher.wants(ALL)
    source.publisher.check_subscribers()
    assert source.publisher.wants([MARKERS])
    source.node.matching.clear()
    source.publisher.check_subscribers()
    assert not source.publisher.wants(ALL)
    assert source.num_changes == 2
    [topic] = source.publisher._topics.by_component[MARKERS]
    topic.wanted = True  # noted in another thread, which has not got further
    source.node.matching.add("/mocap/lab/markers")
    source.publisher.check_subscribers()
    assert source.publisher.wants([MARKERS])
    source.subscribe(is_there=False)
    topic.wanted = True  # between the declaration and the list of topics
    source.publisher._open_for({ANALOG: 1}, source.publisher._parameters)
    assert source.publisher.wants([MARKERS])


def test_new_parameters_have_the_items_of_the_next_frame_noted_again() -> None:
    """Their topics were closed with the former parameters."""
    source = Source()
    source.num_changes = 0
    source.publisher.set_parameters(EACH)
    assert (source.num_changes, source.sender.offered_bytes[-1]) == (1, len(EACH.xml))


# Messages -----------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["big", "little"])
def test_messages_are_in_metres_in_the_frame_of_the_source(order: ByteOrder) -> None:
    """With the capture time; tools out of view have no pose, and markers out of view are NaN."""
    half = math.sqrt(0.5)
    frame = CoordinateFrame("world", 1e-3, (half, 0.0, 0.0, half), (10.0, 0.0, 0.0))  # y up becomes z up
    given = {"markers": 2, "channels": ("Fx", "a,b"), "plates": (Plate("1"),), "frame": frame}
    source = Source(parameters(("wand", "cup"), **given))  # type: ignore[arg-type]
    source.subscribe()
    header, before_ns = ros.header(UTIME, "world"), time.time_ns()
    source.send(
        frame_of(
            (MARKERS, [(0.0, 1000.0, 0.0, 0.25), None]),
            (TOOLS, [None, (1.0, 0.0, 0.0, 0.0, 0.0, 1000.0, 0.0, 0.0)]),
            (FORCE, [(0.0, 700.0, 0.0, 1.0, 0.0, 0.0)]),
            (ANALOG, [1.0, 2.0, -3.0]),
            byte_order=order,
        )
    )
    assert before_ns <= min(source.node.source_times_ns) <= max(source.node.source_times_ns) <= time.time_ns()
    stamped = source.message("cup/pose", "geometry_msgs/msg/PoseStamped")
    [transform] = source.message("/tf", "tf2_msgs/msg/TFMessage").transforms
    assert (transform.header, stamped.header, transform.child_frame_id) == (header, header, "lab/cup")
    moved = transform.transform
    for p, q in (
        (stamped.pose.position, stamped.pose.orientation),
        (moved.translation, moved.rotation),
    ):
        assert (p.x, p.y, p.z) == pytest.approx((10.0, 0.0, 1.0), abs=1e-9)
        assert (q.x, q.y, q.z, q.w) == pytest.approx((half, 0.0, 0.0, half), abs=1e-9)
    cloud = source.message("markers", "sensor_msgs/msg/PointCloud2")
    assert (cloud.header, cloud.width, cloud.is_dense) == (header, 2, False)
    points = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(2, 5)
    assert points[0, :4] == pytest.approx([10.0, 0.0, 1.0, 0.25])
    assert np.isnan(points[1, :3]).all()
    assert points[:, 4].view("<u4").tolist() == [0, 1]
    stamped = source.message("force_1/wrench", "geometry_msgs/msg/WrenchStamped")
    force, torque = stamped.wrench.force, stamped.wrench.torque  # turned, not moved
    assert stamped.header == header
    assert (force.x, force.y, force.z, torque.x) == pytest.approx((0.0, 0.0, 700.0, 1.0), abs=1e-9)
    array = source.message("analog", "std_msgs/msg/Float32MultiArray")
    assert (array.layout.dim[0].label, array.data.tolist()) == ("Fx,a_b,channel 3", [1.0, 2.0, -3.0])


def test_only_components_and_topics_that_are_wanted_are_published() -> None:
    """Encoding for nobody costs time, and numbers count what a topic's subscribers get."""
    source = Source(EACH)
    source.send(ONE_OF_EACH)
    assert source.sent == {}
    source.subscribe("/mocap/lab/wand/pose")
    source.send(ONE_OF_EACH)
    assert source.sent == {"wand/pose": [1]}
    source.subscribe()
    source.send(ONE_OF_EACH, frozenset({MARKERS, FORCE}))
    source.send(ONE_OF_EACH)
    twice = {"wand/pose": [1, 2], "markers": [1, 2], "force_1/wrench": [1, 2]}
    assert source.sent == twice | {"/tf": [1], "analog": [1]}
    assert source.sender.offered_bytes[-1] == len(ONE_OF_EACH.body)
    source.subscribe("/mocap/lab/wand/pose", is_there=False)
    source.send(ONE_OF_EACH)
    assert (source.sent["/tf"], source.sent["wand/pose"]) == ([1, 2], [1, 2])


def test_tools_out_of_view_and_plates_without_values_are_left_out() -> None:
    """One missing value makes a load useless; an empty /tf says nothing."""
    source = Source(parameters(("wand", "cup"), plates=(Plate("1"), Plate("2"), Plate("3"))))
    source.subscribe()
    source.send(tools_frame(None, None))
    source.send(tools_frame(None, (1, 2, 3)))
    source.send(frame_of((FORCE, [(*LOAD[:5], NAN), LOAD])))
    assert source.sent == {"cup/pose": [1], "/tf": [1], "force_2/wrench": [1]}


def test_forces_and_torques_have_units_of_their_own() -> None:
    """Plates give N and Nmm, or others; ROS wants N and Nm."""
    channels = tuple(ForceChannel(str(n), unit=unit) for n, unit in enumerate(("kN",) * 3 + ("Nmm",) * 3))
    source = Source(parameters(plates=(Plate("1", channels=channels),)))
    source.subscribe()
    source.send(frame_of((FORCE, [LOAD])))
    [message] = source.node.messages["/mocap/lab/force_1/wrench"]
    expected = (1000.0, 2000.0, 3000.0, 0.004, 0.005, 0.006)
    assert struct.unpack("<6d", message[-48:]) == pytest.approx(expected)


SQUARE = ((200, 200, 0), (-200, 200, 0), (-200, -200, 0), (200, -200, 0))
UNITS = (*("N",) * 3, *("Nmm",) * 3)


def placed_plate(x: float, y: float) -> Plate:
    """Return a plate whose centre is at x, y in mm, on the floor."""
    corners = tuple(Point(x + dx, y + dy, z, unit="mm") for dx, dy, z in SQUARE)
    return Plate("1", corners=corners, channels=tuple(ForceChannel(unit, unit=unit) for unit in UNITS))


def test_the_load_on_a_plate_is_in_a_frame_at_the_centre_of_its_surface() -> None:
    """500 N downwards, 30 mm in x and -20 mm in y from the centre, give Mx = 10 Nm and My = 15 Nm.

    Quarter turn about z, then 1 m in x: the server's (x, y) becomes (1 - y, x).
    """
    half = math.sqrt(0.5)
    frame = CoordinateFrame("hall", 1e-3, (0.0, 0.0, half, half), (1.0, 0.0, 0.0))
    plates = (placed_plate(600, 300), Plate("2"))
    source = Source(parameters(("wand",), plates=plates, frame=frame))
    source.subscribe()
    source.send(frame_of((FORCE, [(0.0, 0.0, -500.0, 10_000.0, 15_000.0, 0.0), LOAD])))
    [static] = source.message("/tf_static", "tf2_msgs/msg/TFMessage").transforms
    assert (static.header.frame_id, static.child_frame_id) == ("hall", "lab/force_1")
    moved, turned = static.transform.translation, static.transform.rotation
    assert (moved.x, moved.y, moved.z) == pytest.approx((0.7, 0.6, 0.0))
    assert (turned.x, turned.y, turned.z, turned.w) == (0.0, 0.0, 0.0, 1.0)
    load = source.message("force_1/wrench", "geometry_msgs/msg/WrenchStamped")
    assert load.header.frame_id == "lab/force_1"
    assert (load.wrench.torque.x, load.wrench.torque.y) == pytest.approx((-15.0, 10.0))
    pressure = source.message("force_1/centre_of_pressure", "geometry_msgs/msg/PointStamped")
    assert pressure.header.frame_id == "hall"
    assert (pressure.point.x, pressure.point.y) == pytest.approx((0.7 + 0.02, 0.6 + 0.03))
    assert source.message("force_2/wrench", "geometry_msgs/msg/WrenchStamped").header.frame_id == "hall"
    assert "/mocap/lab/force_2/centre_of_pressure" not in source.node.open
    source.send(frame_of((FORCE, [(0.0, 0.0, 1.0, 0.0, 0.0, 0.0), LOAD])))  # 1 N is no contact
    assert (len(source.sent["force_1/wrench"]), len(source.sent["force_1/centre_of_pressure"])) == (2, 1)


def test_static_transforms_are_published_again_to_those_who_come_later() -> None:
    source = Source(parameters(plates=(placed_plate(0, 0),)))
    assert "/tf_static" not in source.sent
    source.subscribe("/tf_static")
    source.node.matching.add("/tf_static")
    source.static.check_subscribers()
    assert source.sent["/tf_static"] == [1, 2]
    source.use(parameters(plates=(placed_plate(100, 0),), version=2))
    assert source.sent["/tf_static"] == [1, 2, 3]
    source.use(parameters(version=3))
    assert "/tf_static" not in source.node.open


def labels_of(cdr: bytes) -> dict[str, dict[str, str]]:
    """Return the labels by component and by what stands for them in topics."""
    array = ros.decoded(cdr, "diagnostic_msgs/msg/DiagnosticArray")
    assert {each.hardware_id for each in array.status} == {"lab"}
    return {each.name: {pair.key: pair.value for pair in each.values} for each in array.status}


def test_labels_are_published_when_they_change_and_for_those_who_come_later() -> None:
    """Points of a cloud have only an index, and names of tools in topics differ from their labels."""
    plates = (Plate("1", "left"),)
    given = parameters(("Left Foot", "cup"), markers=2, channels=("Fx",), plates=plates)
    source = Source(given, tools={"cup": False})
    sent, name = source.node.messages, "/mocap/lab/labels"
    assert name not in sent
    source.subscribe(name)
    source.sender.run()
    expected = {
        "markers": {"0": "marker 1", "1": "marker 2"},
        "tools": {"Left_Foot": "Left Foot"},
        "analog": {"0": "Fx"},
        "force": {"force_1": "left"},
    }
    assert [*map(labels_of, sent[name])] == [expected]
    assert not source.publisher.wants(ALL)  # nobody needs frames for that
    source.use(given._replace(version=2))
    assert len(sent[name]) == 1  # nothing has changed
    source.node.matching.add(name)
    source.publisher.check_subscribers()
    assert sent[name][1] == sent[name][0]
    source.publisher.prepare(frame_of((MARKERS, [None] * 3), (ANALOG, [1.0])).layout, ALL)
    source.sender.run()
    expected["markers"]["2"] = "marker 3"
    assert [*map(labels_of, sent[name][2:])] == [expected]
    source.use(parameters(("cup",), version=3))
    assert len(sent[name]) == 4
    assert labels_of(sent[name][3]) == {"tools": {}}
    source.use(parameters(version=4))
    source.publisher.check_subscribers()
    assert len(sent[name]) == 4
    assert source.node.events[-1] == f"-{name}"


steps = st.tuples(st.sampled_from(["parameters", "frame", "come", "go"]), st.integers(0, 3))


@given(st.lists(steps, max_size=20))
def test_who_subscribes_has_the_newest_labels_whatever_came_before(steps: list[tuple[str, int]]) -> None:
    """Compared with the number of markers that parameters and frames have mentioned."""
    source, name, num_markers = Source(), "/mocap/lab/labels", 0
    for version, (step, count) in enumerate(steps):
        match step:
            case "parameters":
                source.use(parameters(markers=count, version=version))
                num_markers = count
            case "frame":
                source.publisher.prepare(frame_of((MARKERS, [None] * count)).layout, ALL)
                source.sender.run()
                num_markers = max(num_markers, count)
            case "come":
                source.node.matching.add(name)
            case "go":
                source.node.matching.discard(name)
        num_before = len(source.node.messages.get(name, ()))
        source.publisher.check_subscribers()
        source.sender.run()
        sent = source.node.messages.get(name, [])
        assert (len(sent) > num_before) is (name in source.node.matching and num_markers > 0)
        if len(sent) > num_before:
            expected = {str(index): f"marker {index + 1}" for index in range(num_markers)}
            assert labels_of(sent[-1]) == {"markers": expected}
        declared = [event for event in source.node.events if event.endswith(name)]
        assert len(declared) % 2 == (num_markers > 0)


def test_the_number_of_labels_is_bounded() -> None:
    """A frame may have any number of markers."""
    source = Source(parameters(markers=1))
    source.publisher.prepare(frame_of((MARKERS, [None] * (MAX_LABELS + 1))).layout, ALL)
    source.sender.run()
    source.subscribe("/mocap/lab/labels")
    source.sender.run()
    [message] = source.node.messages["/mocap/lab/labels"]
    assert len(labels_of(message)["markers"]) == MAX_LABELS


def test_the_frames_of_plates_and_tools_differ() -> None:
    source = Source(parameters(("force_1",), plates=(placed_plate(0, 0),)))
    assert {"/mocap/lab/tool_force_1/pose", "/mocap/lab/force_1/wrench"} < source.node.open


def test_events_have_names_and_their_own_times() -> None:
    """A node must not have to know the ids of the server. Their frame has the time stamp 1000 µs."""
    source = Source(parameters(events=(EventDefinition("7", "Trigger"),)))
    assert source.node.open == {"/tf", "/mocap/lab/events"}
    source.subscribe()
    source.send(frame_of((EVENT, [(7, 800, 1, -1, -1), (8, 1 << 40, -1, -1, -1)])))
    found = [
        ros.decoded(cdr, "diagnostic_msgs/msg/DiagnosticArray")
        for cdr in source.node.messages["/mocap/lab/events"]
    ]
    assert [each.header for each in found] == [ros.header(UTIME - 200, ""), ros.header(UTIME, "")]
    assert [each.status[0].name for each in found] == ["Trigger", "event 8"]
    assert [(pair.key, pair.value) for pair in found[0].status[0].values] == [("id", "7"), ("param1", "1")]
    short = np.array([(7, 1, -1, -1)], SHORT_EVENT)
    source.send(
        split_frame(encode_frame([encode_component(EVENT, 7, 1000, short, "little")], "little"), "little")
    )
    newest = ros.decoded(source.node.messages["/mocap/lab/events"][2], "diagnostic_msgs/msg/DiagnosticArray")
    assert (newest.header, newest.status[0].name) == (ros.header(UTIME + 1, ""), "Trigger")


def test_events_without_a_description_open_their_topic_and_are_bounded() -> None:
    source = Source(parameters())
    event = (7, 1000, -1, -1, -1)
    source.publisher.prepare(frame_of((EVENT, [event])).layout, ALL)
    source.sender.run()
    assert not source.publisher.wants(ALL)
    source.subscribe("/mocap/lab/events")
    assert source.publisher.wants([EVENT])
    source.send(frame_of((EVENT, [event] * (MAX_EVENTS + 2))))
    assert len(source.sent["events"]) == MAX_EVENTS
    assert source.lost == {"too many events": (2, 1)}


@pytest.mark.parametrize("counts", [(3, 1, 2), (0, 2)])
def test_the_number_of_items_can_change_from_frame_to_frame(counts: tuple[int, ...]) -> None:
    """A message has as many points or values as its frame, whatever came before."""
    source = Source(EACH)
    source.subscribe()
    for count in counts:
        source.send(frame_of((MARKERS, [(1, 2, 3, 0)] * count), (ANALOG, [1.0] * count)))
    clouds, arrays = (source.node.messages[f"/mocap/lab/{name}"] for name in ("markers", "analog"))
    assert len({len(cloud) - 20 * count for cloud, count in zip(clouds, counts, strict=True)}) == 1
    for array, count in zip(arrays, counts, strict=True):
        assert array.endswith(struct.pack(f"<I{count}f", count, *[1.0] * count))


# Losses -------------------------------------------------------------------------------------


def test_an_unknown_unit_is_counted_by_the_messages_that_somebody_misses() -> None:
    """Lengths that are not in metres must not reach robots; analog values do."""
    frame = CoordinateFrame("lab", None)
    source = Source(parameters(("wand", "cup"), markers=1, channels=("Fx",), unit="furlong", frame=frame))
    source.send(ONE_OF_EACH)
    assert source.lost == {}
    source.subscribe("/tf", "/mocap/lab/wand/pose", "/mocap/lab/markers", "/mocap/lab/analog")
    source.send(ONE_OF_EACH)
    assert source.lost == {"unknown unit": (3, 2)}  # the cloud, the pose, /tf
    assert source.sent == {"analog": [1]}


def test_frames_that_find_no_place_use_up_the_numbers_of_their_topics() -> None:
    """ROS notices the gap: of the lost components, with a subscriber, and each frame once."""
    source = Source(EACH)
    source.subscribe("/mocap/lab/markers", "/mocap/lab/analog")
    source.send(ONE_OF_EACH)
    for lost in (2, 3):
        source.sender.is_full = True
        for _ in range(lost):
            assert cause_of(source.offer, ONE_OF_EACH, frozenset({MARKERS, FORCE})) == "queue full"
        source.sender.is_full = False
        source.offer(ONE_OF_EACH)
    source.offer(ONE_OF_EACH)
    source.sender.run()
    assert source.sent == {"markers": [1, 4, 8, 9], "analog": [1, 2, 3, 4]}
    source.subscribe("/mocap/lab/force_1/wrench")
    source.send(ONE_OF_EACH)
    assert source.sent["force_1/wrench"] == [1]


def test_frames_are_refused_while_the_router_is_away() -> None:
    """Those that waited are counted, and the next ones go on."""
    source = Source(EACH)
    source.subscribe("/mocap/lab/markers")
    source.offer(ONE_MARKER)
    source.router.is_cut_off = True
    assert cause_of(source.offer, ONE_MARKER) == "no router"
    source.sender.run()
    assert (source.lost, source.sent) == ({"no router": (1, 1)}, {})
    source.router.is_cut_off = False
    source.send(ONE_MARKER)
    assert source.sent == {"markers": [1]}


def test_what_is_not_sent_is_counted_unless_the_session_is_gone() -> None:
    """A defect ends nothing. At the gateway's end, the session closes before the last messages."""
    source = Source(EACH)
    source.subscribe("/mocap/lab/markers")
    for error in (zenoh.ZError("no"), ZeroDivisionError("x")):
        source.node.put = Mock(side_effect=error)
        source.send(ONE_MARKER)
    lost = {"put failed": (1, 1), "ZeroDivisionError": (1, 1)}
    assert source.lost == lost
    source.node.put = lambda: None
    source.send(ONE_MARKER)
    assert source.sent["markers"] == [3]

    def cut_off() -> None:
        source.router.is_cut_off = True
        raise zenoh.ZError("closed")

    source.node.put = cut_off
    source.send(ONE_MARKER)
    assert source.lost == lost


def test_a_closed_source_publishes_nothing_more_and_its_topics_go() -> None:
    """Frames of it may still be in the queue, and subscribers may still come and go."""
    source = Source(EACH)
    source.subscribe()
    source.offer(ONE_OF_EACH)
    source.num_changes = 0
    source.publisher.close()
    assert source.num_changes == 1
    assert not source.publisher.wants(ALL)
    source.sender.run()
    assert (source.sent, source.node.open, source.publisher.topics) == ({}, {"/tf"}, ())
    assert source.node.events[-1] == "-/mocap/lab/labels"
    source.subscribe()
    source.publisher.update_wanted()
    assert not source.publisher.wants(ALL)
    assert cause_of(source.offer, ONE_OF_EACH) == "closed"
    assert source.publisher._wanted == frozenset()


# Stamps -------------------------------------------------------------------------------------


def stamps_of(source: Source, name: str) -> list[int]:
    """Return the stamps of the messages of a topic in µs."""
    times = [struct.unpack_from("<iI", cdr, 4) for cdr in source.node.messages[f"/mocap/lab/{name}"]]
    return [seconds * 1_000_000 + nanoseconds // 1000 for seconds, nanoseconds in times]


@given(
    st.lists(
        st.tuples(
            st.sampled_from([0, 0, 0, 1, 3, 5_000, -2, -3_600_000_000]),
            st.sampled_from([(MARKERS,), (TOOLS,), (MARKERS, TOOLS)]),
        ),
        max_size=40,
    )
)
def test_frames_of_one_component_have_distinct_stamps_and_the_components_of_a_frame_one(
    steps: list[tuple[int, tuple[ComponentType, ...]]],
) -> None:
    """Of 33 poses with one stamp at the beginning of a session under load, tf2 kept the last."""
    source = Source(EACH)
    source.subscribe()
    utime = UTIME
    both: list[bool] = []
    for step, kinds in steps:
        utime += step
        before = len(source.node.messages.get("/mocap/lab/markers", ()))
        source.publisher.publish(ONE_OF_EACH, stamp(utime), frozenset(kinds))
        source.sender.run()
        if len(kinds) == 2:
            both.append(stamps_of(source, "markers")[before] == stamps_of(source, "wand/pose")[-1])
        for name, kind in (("markers", MARKERS), ("wand/pose", TOOLS)):
            if kind in kinds:
                assert 0 <= stamps_of(source, name)[-1] - utime <= 3 * len(steps)
    assert all(both)
    for name in ("markers", "wand/pose"):
        stamps = stamps_of(source, name) if f"/mocap/lab/{name}" in source.node.messages else []
        assert all(after > before or before - after > 1_000_000 for before, after in pairwise(stamps))


def test_frames_of_two_streams_that_were_captured_together_keep_one_stamp() -> None:
    """Programs pair markers and poses by equal stamps."""
    source = Source(EACH)
    source.subscribe()
    for number in range(3):
        for kind in (MARKERS, TOOLS):
            source.publisher.publish(ONE_OF_EACH, stamp(UTIME + 10 * number), frozenset([kind]))
    source.sender.run()
    assert stamps_of(source, "markers") == stamps_of(source, "wand/pose")
    assert stamps_of(source, "markers") == [UTIME, UTIME + 10, UTIME + 20]
