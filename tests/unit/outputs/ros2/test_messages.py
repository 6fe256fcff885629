"""Each message byte by byte, worked out by hand, and compared with what rosbags writes."""

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

UTIME = 1_700_000_000_000_001
STAMP = bytes.fromhex("00f15365 e8030000")  # 1700000000 s and 1000 ns
POSE = (1.0, 2.0, -3.0, 0.0, 0.0, 0.0, 1.0)
POSE_BYTES = bytes.fromhex(
    "000000000000f03f 0000000000000040 00000000000008c0"
    "0000000000000000 0000000000000000 0000000000000000 000000000000f03f"
)
ENCAPSULATION = bytes.fromhex("00010000")

# What a string can hold in ROS: anything but NUL and lone surrogates.
texts = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=40)
utimes = st.integers(-(2**31) * 10**6, 2**31 * 10**6 - 1)
doubles = st.floats()
poses = st.tuples(*7 * [doubles])


# By hand -------------------------------------------------------------------------------------


def test_a_pose_by_hand() -> None:
    by_hand = ENCAPSULATION + STAMP + bytes.fromhex("04000000 6c616200") + POSE_BYTES  # "lab", aligned to 8
    assert StampedEncoder("lab").encode(cdr.stamp(UTIME), pack_pose(*POSE)) == by_hand


def test_a_wrench_by_hand() -> None:
    # "world" takes 6 bytes from offset 12; 6 more align the force to 24.
    by_hand = (
        ENCAPSULATION
        + STAMP
        + bytes.fromhex("06000000 776f726c6400 000000000000")
        + bytes.fromhex("000000000000f03f 0000000000000000 0000000000808840")
        + bytes(24)
    )
    assert StampedEncoder("world").encode(STAMP, pack_wrench(1.0, 0.0, 784.0, 0.0, 0.0, 0.0)) == by_hand


def test_two_transforms_by_hand() -> None:
    # The number 2 makes the first transform begin at 4, so that its names end at 33 and need 7 bytes.
    first = STAMP + bytes.fromhex("04000000 6c616200 09000000 6c61622f77616e6400") + bytes(7) + POSE_BYTES
    # The second one begins at 96 and ends its names at 125, which need 3 bytes.
    second = STAMP + bytes.fromhex("04000000 6c616200 09000000 6c61622f666f6f7400") + bytes(3) + POSE_BYTES
    by_hand = ENCAPSULATION + bytes.fromhex("02000000") + first + second
    transforms = [(TransformNames("lab", child), POSE_BYTES) for child in ("lab/wand", "lab/foot")]
    assert tf_message(STAMP, transforms) == by_hand


def test_no_transforms_by_hand() -> None:
    assert tf_message(STAMP, []) == ENCAPSULATION + bytes(4)


def test_a_cloud_by_hand() -> None:
    def field(name: bytes, offset: int, datatype: int) -> bytes:
        text = name + b"\0"
        aligned = text + bytes(-len(text) % 4)
        return (
            len(text).to_bytes(4, "little")
            + aligned
            + offset.to_bytes(4, "little")
            + bytes([datatype, 0, 0, 0])
            + (1).to_bytes(4, "little")
        )

    by_hand = (
        ENCAPSULATION
        + STAMP
        + bytes.fromhex("04000000 6c616200")
        + bytes.fromhex("01000000 02000000 05000000")  # height, width, number of fields
        + field(b"x", 0, 7)
        + field(b"y", 4, 7)
        + field(b"z", 8, 7)
        + field(b"reliability", 12, 7)
        + field(b"marker", 16, 6)
        + bytes.fromhex("00000000")  # little-endian, and padding
        + bytes.fromhex("14000000 28000000 28000000")  # point_step, row_step, bytes of data
        + bytes.fromhex("0000803f 00000040 00004040 0000003f 00000000")  # 1, 2, 3, 0.5, marker 0
        + bytes.fromhex("0000c07f 0000c07f 0000c07f 00c07944 01000000")  # missing, 999, marker 1
        + b"\0"  # not dense
    )
    positions = np.array([[1.0, 2.0, 3.0], [7.0, math.nan, 7.0]])
    assert CloudEncoder("lab", 2).encode(STAMP, positions, np.array([0.5, 999.0])) == by_hand


def test_channels_by_hand() -> None:
    by_hand = (
        ENCAPSULATION
        + bytes.fromhex("01000000 06000000 46782c467900 0000")  # one dimension, "Fx,Fy", padding
        + bytes.fromhex("02000000 02000000 00000000 02000000")  # size, stride, offset, number of values
        + bytes.fromhex("0000803f 000000c0")
    )
    assert AnalogEncoder(["Fx", "Fy"]).encode(np.array([1.0, -2.0], ">f4")) == by_hand


def test_diagnostics_by_hand() -> None:
    by_hand = (
        ENCAPSULATION
        + STAMP
        + bytes.fromhex("01000000 00 000000")  # the frame "", padding
        + bytes.fromhex("01000000")  # one status
        + bytes.fromhex("02 000000 04000000 6c616200")  # ERROR, padding, "lab"
        + bytes.fromhex("04000000 6f666600")  # "off"
        + bytes.fromhex("01000000 00 000000")  # no hardware_id
        + bytes.fromhex("01000000")  # one value
        + bytes.fromhex("02000000 6b00 0000 02000000 7600")  # k, v
    )
    assert diagnostic_array(STAMP, [DiagnosticStatus(2, "lab", "off", "", {"k": "v"})]) == by_hand


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


def test_positions_beyond_float32_are_infinite() -> None:
    cloud = CloudEncoder("lab", 1).encode(STAMP, np.array([[1e300, -1e300, 0.0]]), np.zeros(1))
    message = ros.decoded(cloud, "sensor_msgs/msg/PointCloud2")
    assert np.frombuffer(message.data.tobytes(), "<f4")[:3].tolist() == [math.inf, -math.inf, 0.0]
    assert not message.is_dense


# Compared with rosbags -----------------------------------------------------------------------


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
    assert [(field.name, field.offset, field.datatype, field.count) for field in cloud.fields] == [
        ("x", 0, 7, 1),
        ("y", 4, 7, 1),
        ("z", 8, 7, 1),
        ("reliability", 12, 7, 1),
        ("marker", 16, 6, 1),
    ]
    assert (cloud.height, cloud.width, cloud.point_step, cloud.row_step) == (
        1,
        len(markers),
        20,
        20 * len(markers),
    )
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
                level=status.level,
                name=status.name,
                message=status.message,
                hardware_id=status.hardware_id,
                values=[
                    ros.message("diagnostic_msgs/msg/KeyValue", key=key, value=value)
                    for key, value in status.values.items()
                ],
            )
            for status in statuses
        ],
    )
    assert ours == ros.encoded(theirs)
