"""Each message byte by byte, compared with what rosbags writes."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.outputs.ros2 import cdr
from gateway.outputs.ros2.messages import (
    AnalogEncoder,
    CloudEncoder,
    DiagnosticStatus,
    StampedEncoder,
    TransformNames,
    diagnostic_array,
    pack_pose,
    pack_wrench,
    tf_message,
)
from tests.unit.outputs.ros2 import ros_messages as ros

STAMP = bytes(8)

# What a string can hold in ROS: anything but NUL and lone surrogates.
texts = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=40)
utimes = st.integers(-(2**31) * 10**6, 2**31 * 10**6 - 1)
doubles = st.floats()
poses = st.tuples(*7 * [doubles])


@pytest.mark.parametrize(
    ("utime", "stamp"),
    [
        (0, "00000000 00000000"),
        (-1, "ffffffff 18c69a3b"),  # one µs before 1970: -1 s and 999999000 ns
        (2**31 * 10**6, "ffffff7f 00000000"),  # in 2038, the seconds are full
        (-(2**63), "00000080 d83d9a35"),
    ],
)
def test_a_stamp_is_moved_into_its_range(utime: int, stamp: str) -> None:
    assert cdr.stamp(utime)[:4] == bytes.fromhex(stamp)[:4]
    assert int.from_bytes(cdr.stamp(utime)[4:], "little") < 1_000_000_000


def test_a_text_with_nul_or_half_a_character_is_still_one_text() -> None:
    array = diagnostic_array(STAMP, [DiagnosticStatus(0, "a\0b", "\ud800", "", {})])
    [status] = ros.decoded(array, "diagnostic_msgs/msg/DiagnosticArray").status
    assert (status.name, status.message) == ("a\ufffdb", "?")


def test_a_cloud_has_its_numbers_in_the_order_of_its_fields() -> None:
    """Positions beyond float32 are infinite; one missing coordinate makes a marker missing."""
    positions = np.array([[1e300, -1e300, 3.0], [7.0, math.nan, 7.0]])
    cloud = CloudEncoder("lab", 2).encode(STAMP, positions, np.array([0.5, 999.0]))
    message = ros.decoded(cloud, "sensor_msgs/msg/PointCloud2")
    assert message.data.tobytes() == bytes.fromhex(
        "0000807f 000080ff 00004040 0000003f 00000000"  # marker 0
        "0000c07f 0000c07f 0000c07f 00c07944 01000000"  # missing, 999, marker 1
    )
    assert not message.is_dense


@given(utimes, texts, poses)
def test_poses_equal_those_of_rosbags(utime: int, frame_id: str, pose: tuple[float, ...]) -> None:
    ours = StampedEncoder(frame_id).encode(cdr.stamp(utime), pack_pose(*pose))
    assert ours == ros.encoded(ros.pose_stamped(utime, frame_id, pose))


@given(utimes, texts, st.tuples(*6 * [doubles]))
def test_wrenches_equal_those_of_rosbags(utime: int, frame_id: str, wrench: tuple[float, ...]) -> None:
    ours = StampedEncoder(frame_id).encode(cdr.stamp(utime), pack_wrench(*wrench))
    assert ours == ros.encoded(ros.wrench_stamped(utime, frame_id, wrench))


@given(utimes, texts, st.lists(st.tuples(texts, poses), max_size=5))
def test_transforms_equal_those_of_rosbags(
    utime: int, frame_id: str, children: list[tuple[str, tuple[float, ...]]]
) -> None:
    ours = tf_message(
        cdr.stamp(utime), [(TransformNames(frame_id, child), pack_pose(*pose)) for child, pose in children]
    )
    assert ours == ros.encoded(ros.tf_message(utime, frame_id, children))


@given(utimes, texts, st.lists(st.tuples(*4 * [st.floats(width=32)]), max_size=6))
def test_clouds_equal_those_of_rosbags(utime: int, frame_id: str, markers: list[tuple[float, ...]]) -> None:
    values = np.array(markers, dtype=np.float64).reshape(-1, 4)
    ours = CloudEncoder(frame_id, len(markers)).encode(
        cdr.stamp(utime), values[:, :3].copy(), values[:, 3].astype(np.float32)
    )
    cloud = ros.decoded(ours, "sensor_msgs/msg/PointCloud2")
    assert ros.encoded(cloud) == ours
    assert cloud.header == ros.header(utime, frame_id)
    floats = [(name, 4 * index, 7, 1) for index, name in enumerate(("x", "y", "z", "reliability"))]
    fields = [(field.name, field.offset, field.datatype, field.count) for field in cloud.fields]
    assert fields == [*floats, ("marker", 16, 6, 1)]
    sizes = (cloud.height, cloud.width, cloud.point_step, cloud.row_step, cloud.is_bigendian)
    assert sizes == (1, len(markers), 20, 20 * len(markers), False)
    points = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(-1, 5)
    is_missing = np.isnan(values[:, :3]).any(axis=1)
    assert bool(cloud.is_dense) == np.isfinite(points[:, :3]).all()
    assert np.array_equal(points[:, :3][~is_missing], values[:, :3][~is_missing])
    assert np.isnan(points[:, :3][is_missing]).all()
    assert np.array_equal(points[:, 3], values[:, 3].astype(np.float32), equal_nan=True)
    assert points[:, 4].tobytes() == np.arange(len(markers), dtype="<u4").tobytes()


@given(st.lists(st.tuples(texts, st.floats(width=32)), max_size=8))
def test_channels_equal_those_of_rosbags(channels: list[tuple[str, float]]) -> None:
    labels = [label for label, _ in channels]
    values = np.array([value for _, value in channels], ">f4")
    ours = AnalogEncoder(labels).encode(values)
    array = ros.decoded(ours, "std_msgs/msg/Float32MultiArray")
    assert ros.encoded(array) == ours
    [dimension] = array.layout.dim
    assert dimension.label == ",".join(label.replace(",", "_") for label in labels)
    assert (dimension.size, dimension.stride, array.layout.data_offset) == (len(labels), len(labels), 0)
    assert np.array_equal(array.data, values.astype("<f4"), equal_nan=True)


@pytest.mark.parametrize(("label", "is_kept"), [("é" * 8192, True), ("é" * 8192 + "x", False)])
def test_labels_that_are_too_long_are_left_out(label: str, is_kept: bool) -> None:
    """They are in every message; 16 KiB count in UTF-8."""
    array = ros.decoded(AnalogEncoder([label]).encode(np.zeros(1, ">f4")), "std_msgs/msg/Float32MultiArray")
    assert array.layout.dim[0].label == (label if is_kept else "channels")


statuses = st.lists(
    st.builds(
        DiagnosticStatus, st.integers(0, 3), texts, texts, texts, st.dictionaries(texts, texts, max_size=4)
    ),
    max_size=4,
)


@given(utimes, statuses)
def test_diagnostics_equal_those_of_rosbags(utime: int, statuses: list[DiagnosticStatus]) -> None:
    ours = diagnostic_array(cdr.stamp(utime), statuses)
    theirs: Any = ros.message(
        "diagnostic_msgs/msg/DiagnosticArray",
        header=ros.header(utime, ""),
        status=[
            ros.message(
                "diagnostic_msgs/msg/DiagnosticStatus",
                **dict(zip(("level", "name", "message", "hardware_id"), status, strict=False)),
                values=[
                    ros.message("diagnostic_msgs/msg/KeyValue", key=key, value=value)
                    for key, value in status.values.items()
                ],
            )
            for status in statuses
        ],
    )
    assert ours == ros.encoded(theirs)
