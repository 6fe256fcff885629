"""Poses and positions in a source's coordinate frame, and the messages of poses."""

import math
import struct
from itertools import chain
from typing import Any

import numpy as np
import pytest
import rtc3d

from gateway.messages.coordinate_frame import CoordinateFrame, Quaternion
from gateway.messages.encode import Stamp, metres_per_unit, tool_poses
from gateway.rtc3d.components import Component
from gateway.rtc3d.frames import split_frame
from tests.support.vectors import ALL_ONES

HALF = math.sqrt(0.5)
QUARTER_ABOUT_Z: Quaternion = (0.0, 0.0, HALF, HALF)
HALL = CoordinateFrame("hall", 0.01, QUARTER_ABOUT_Z, (10.0, 20.0, 30.0))
NAN = math.nan
STAMP = Stamp(utime=2, capture_utime=1, session=3, parameters_version=5)


def tools(*poses: tuple[float, ...]) -> Component:
    """Return a 6D component; each tool has q0, qx, qy, qz, x, y, z, error."""
    wire = struct.pack(">IIiqI", 24 + 32 * len(poses), 4, 4, 7500, len(poses))
    wire += struct.pack(f">{8 * len(poses)}f", *chain.from_iterable(poses))
    (component,) = split_frame(struct.pack(">I", 1) + wire, "big").components
    return component


def pose_of(pose: tuple[float, ...], unit_m: float = 1e-3) -> Any:
    [message] = tool_poses(tools(pose), STAMP, [41], CoordinateFrame("lab", unit_m))
    return rtc3d.tool_pose_t.decode(message)


def test_positions_are_scaled_then_rotated_then_moved_and_vectors_only_rotated() -> None:
    positions = np.array([[100, 0, 0], [0, 200, 0], [NAN, 0, 300]], ">f4")
    expected = np.array([[10, 21, 30], [8, 20, 30], [NAN, NAN, NAN]])
    np.testing.assert_allclose(HALL.points(positions), expected, atol=1e-12)
    np.testing.assert_allclose(HALL.vectors(np.array([[100.0, 0, 5]])), [[0, 100, 5]], atol=1e-12)
    [pose] = HALL.poses(tools((1, 0, 0, 0, 100, 200, 300, 50)).items())
    assert pose == pytest.approx((8.0, 21.0, 33.0, 0.0, 0.0, HALF, HALF, 0.5))


@pytest.mark.parametrize("bits", ["7f800000", "ff800000", "7f800001", "7f7fffff", "ffffffff"])
def test_any_bits_are_converted_without_a_warning(bits: str) -> None:
    """Infinity, a signalling NaN, the largest number, and out of view; warnings are errors in tests."""
    values = np.frombuffer(bytes.fromhex(bits * 3), ">f4").reshape(1, 3)
    for frame in (CoordinateFrame("lab"), CoordinateFrame("hall", 1e6, QUARTER_ABOUT_Z, (1.0, 2.0, 3.0))):
        assert frame.points(values).shape == frame.vectors(values).shape == (1, 3)


def test_a_tool_with_any_value_that_is_no_number_is_out_of_view() -> None:
    """A robot must never get a part of a pose, whether it is transformed or not."""
    for field in range(8):
        for value in (NAN, ALL_ONES, math.inf, -math.inf):
            values = [1.0, 0, 0, 0, 100, 200, 300, 0.5]
            values[field] = value
            for frame in (CoordinateFrame("lab"), CoordinateFrame("lab", 1e-3, QUARTER_ABOUT_Z)):
                assert frame.poses(tools(tuple(values)).items()) == [None]
            pose = pose_of(tuple(values))
            assert not pose.visible
            assert all(map(math.isnan, (*pose.position_m, *pose.orientation_xyzw, pose.error_m)))
    beyond_float = tools((1, 0, 0, 0, 3e38, 0, 0, 0)).items()
    assert CoordinateFrame("lab", 1000.0).poses(beyond_float) == [None]


def test_a_quaternion_of_zeros_is_no_rotation_but_part_of_a_message() -> None:
    zeros = (0.0,) * 8
    assert CoordinateFrame("lab").poses(tools(zeros).items()) == [None]
    assert CoordinateFrame("lab").poses(tools(zeros).items(), accept_zeros=True) == [zeros]
    pose = pose_of(zeros)
    assert (pose.visible, *pose.position_m, *pose.orientation_xyzw, pose.error_m) == (True, *zeros)


def test_a_component_in_metres_is_not_scaled_and_one_without_tools_gives_no_poses() -> None:
    pose = pose_of((1.0, 0.0, 0.0, 0.0, 1.5, -2.0, 0.25, 0.0625), unit_m=1.0)
    assert (pose.position_m, pose.error_m) == ((1.5, -2.0, 0.25), 0.0625)
    assert tool_poses(tools(), STAMP, [], CoordinateFrame("lab")) == []


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        *(("mm", 0.001), (" MM ", 0.001), ("", 0.001), ("m", 1.0), ("cm", 0.01), ("um", 1e-6)),  # §6.2: mm
        *(
            ("\u00b5m", 1e-6),
            ("\u03bcm", 1e-6),
            ("in", 0.0254),
            ("inch", 0.0254),
            ("Feet", 0.3048),
            ("M", 1.0),
        ),
        *(("Millimeters", 1e-3), ("furlong", None), ("mV", None), ("m m", None)),
    ],
)
def test_units_of_length_convert_to_metres(unit: str, metres: float | None) -> None:
    assert metres_per_unit(unit) == metres
