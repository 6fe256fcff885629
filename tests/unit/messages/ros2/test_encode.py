"""Each message byte by byte, compared with what ROS 2 has written, and rosbags with random contents."""

import math
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from gateway.messages.ros2.definitions import definition
from gateway.messages.ros2.encode import (
    ENCAPSULATION,
    ROS_TYPES,
    AnalogEncoder,
    CloudEncoder,
    DiagnosticStatus,
    RosType,
    StampedEncoder,
    TransformNames,
    diagnostic_array,
    pack_pose,
    pack_wrench,
    ros_stamp,
    ros_stamps,
    tf_message,
)
from tests.support import ros_messages as ros

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
    assert ros_stamp(utime)[:4] == bytes.fromhex(stamp)[:4]
    assert int.from_bytes(ros_stamp(utime)[4:], "little") < 1_000_000_000


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


REAL_STAMP = ros_stamp(1_700_000_000_000_001)
REAL_POSE = pack_pose(0.1, -2, 3, 0, 0.6, 0, 0.8)


# What rclpy.serialization.serialize_message returns for the same values. It was run in a virtual environment
# of its own with the wheels ros-kilted-rclpy 9.1.2, ros-kilted-rmw-fastrtps-cpp 9.3.3 and the messages 5.5.1;
# those of Jazzy write the same. Fast CDR leaves in the padding what was in memory: bytes that
# deserialize_message ignores are 0 here. The wheels are not installed with the other packages, because their
# ros-wheels-bootstrapper starts each Python process again with another LD_LIBRARY_PATH. There is no wheel of
# tf2_msgs; a TFMessage is a sequence of TransformStamped.
@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        pytest.param(
            StampedEncoder("hall-2").encode(REAL_STAMP, REAL_POSE),
            "0001000000f15365e80300000700000068616c6c2d320000000000009a9999999999b93f00000000000000c000000000"
            "000008400000000000000000333333333333e33f00000000000000009a9999999999e93f",
            id="geometry_msgs/msg/PoseStamped",
        ),
        pytest.param(
            StampedEncoder("hall-2").encode(REAL_STAMP, pack_wrench(0.1, -2, 700, 4, -5, 6)),
            "0001000000f15365e80300000700000068616c6c2d320000000000009a9999999999b93f00000000000000c000000000"
            "00e08540000000000000104000000000000014c00000000000001840",
            id="geometry_msgs/msg/WrenchStamped",
        ),
        pytest.param(
            b"%b%b%b%b"
            % (
                ENCAPSULATION,
                REAL_STAMP,
                TransformNames("hall-2", "hall-2/Left_Foot").later,
                REAL_POSE,
            ),
            "0001000000f15365e80300000700000068616c6c2d3200001100000068616c6c2d322f4c6566745f466f6f7400000000"
            "000000009a9999999999b93f00000000000000c000000000000008400000000000000000333333333333e33f00000000"
            "000000009a9999999999e93f",
            id="geometry_msgs/msg/TransformStamped",
        ),
        pytest.param(
            CloudEncoder("hall-2", 2).encode(
                REAL_STAMP, np.array([[1, 2, 3], [math.nan] * 3]), np.array([0.5, 999])
            ),
            "0001000000f15365e80300000700000068616c6c2d320000010000000200000005000000020000007800000000000000"
            "07000000010000000200000079000000040000000700000001000000020000007a000000080000000700000001000000"
            "0c00000072656c696162696c697479000c0000000700000001000000070000006d61726b657200001000000006000000"
            "01000000000000001400000028000000280000000000803f00000040000040400000003f000000000000c07f0000c07f"
            "0000c07f00c079440100000000",
            id="sensor_msgs/msg/PointCloud2",
        ),
        pytest.param(
            AnalogEncoder(["EMG é", "Fx"]).encode(np.array([0.5, -1.25])),
            "00010000010000000a000000454d4720c3a92c4678000000020000000200000000000000020000000000003f0000a0bf",
            id="std_msgs/msg/Float32MultiArray",
        ),
        pytest.param(
            diagnostic_array(
                REAL_STAMP,
                [
                    DiagnosticStatus(
                        1,
                        "rtc3d_gateway: lab 3d",
                        "streaming",
                        "192.0.2.20:3020",
                        {"rate (Hz)": "200.0", "lag": "é"},
                    ),
                    DiagnosticStatus(0, "to ros2", "", "", {}),
                ],
            ),
            "0001000000f15365e8030000010000000000000002000000010000001600000072746333645f676174657761793a206c"
            "61622033640000000a00000073747265616d696e67000000100000003139322e302e322e32303a333032300002000000"
            "0a000000726174652028487a29000000060000003230302e30000000040000006c61670003000000c3a9000008000000"
            "746f20726f7332000100000000000000010000000000000000000000",
            id="diagnostic_msgs/msg/DiagnosticArray",
        ),
    ],
)
def test_messages_equal_those_of_real_ros(ours: bytes, theirs: str) -> None:
    assert ours == bytes.fromhex(theirs)


@given(utimes, texts, st.tuples(*6 * [doubles]))
def test_wrenches_equal_those_of_rosbags(utime: int, frame_id: str, wrench: tuple[float, ...]) -> None:
    ours = StampedEncoder(frame_id).encode(ros_stamp(utime), pack_wrench(*wrench))
    assert ours == ros.encoded(ros.wrench_stamped(utime, frame_id, wrench))


@given(utimes, texts, st.lists(st.tuples(texts, poses), max_size=5))
def test_transforms_equal_those_of_rosbags(
    utime: int, frame_id: str, children: list[tuple[str, tuple[float, ...]]]
) -> None:
    ours = tf_message(
        ros_stamp(utime),
        [(TransformNames(frame_id, child), pack_pose(*pose)) for child, pose in children],
    )
    assert ours == ros.encoded(ros.tf_message(utime, frame_id, children))


@given(utimes, texts, st.lists(st.tuples(*4 * [st.floats(width=32)]), max_size=6))
def test_clouds_equal_those_of_rosbags(utime: int, frame_id: str, markers: list[tuple[float, ...]]) -> None:
    values = np.array(markers, dtype=np.float64).reshape(-1, 4)
    ours = CloudEncoder(frame_id, len(markers)).encode(
        ros_stamp(utime), values[:, :3].copy(), values[:, 3].astype(np.float32)
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


@given(st.lists(utimes, max_size=4), texts, st.data())
def test_rows_are_the_messages_of_each_row(utimes: list[int], frame_id: str, data: st.DataObject) -> None:
    """A bag has whole blocks of messages that are published one by one."""

    def numbers(*shape: int, width: Literal[32, 64] = 64) -> npt.NDArray[np.float64]:
        count = math.prod(shape)
        return np.array(data.draw(st.lists(st.floats(width=width), min_size=count, max_size=count))).reshape(
            shape
        )

    stamps, times = ros_stamps(np.array(utimes, np.int64)), [*map(ros_stamp, utimes)]
    wrenches = numbers(len(utimes), 6)
    stamped = StampedEncoder(frame_id)
    assert stamped.encode_rows(stamps, wrenches) == [
        stamped.encode(stamp, pack_wrench(*wrench)) for stamp, wrench in zip(times, wrenches, strict=True)
    ]
    clouds = numbers(len(utimes), 2, 4, width=32)
    cloud = CloudEncoder(frame_id, 2)
    assert cloud.encode_rows(stamps, clouds[..., :3], clouds[..., 3]) == [
        cloud.encode(stamp, each[:, :3], each[:, 3]) for stamp, each in zip(times, clouds, strict=True)
    ]
    channels = AnalogEncoder(["a", "b", "c"])
    values = numbers(len(utimes), 3, width=32)
    assert channels.encode_rows(values) == [channels.encode(each) for each in values]


@pytest.mark.parametrize("ros_type", ROS_TYPES)
def test_the_definitions_have_the_hashes_of_ros(ros_type: RosType) -> None:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition(ros_type), ros_type.name))
    assert store.hash_rihs01(ros_type.name) == ros_type.type_hash


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
    ours = diagnostic_array(ros_stamp(utime), statuses)
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
