import math

import numpy as np
import pytest

from gateway.messages.coordinate_frame import CoordinateFrame, Quaternion
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType, Items

HALF = math.sqrt(0.5)
QUARTER_ABOUT_Z: Quaternion = (0.0, 0.0, HALF, HALF)
NAN = math.nan


def tools(*items: tuple[float, ...]) -> Items:
    """Return items of a 6D component: q0, qx, qy, qz, x, y, z, error."""
    return np.array(list(items), ITEM_DTYPES[ComponentType.TOOLS].newbyteorder(">"))


def test_positions_are_scaled_then_rotated_then_moved() -> None:
    frame = CoordinateFrame("hall", 0.01, QUARTER_ABOUT_Z, (10.0, 20.0, 30.0))
    positions = np.array([[100, 0, 0], [0, 200, 0], [NAN, 0, 300]], ">f4")
    expected = np.array([[10, 21, 30], [8, 20, 30], [NAN, NAN, NAN]])
    np.testing.assert_allclose(frame.points(positions), expected, atol=1e-12)


def test_vectors_are_only_rotated() -> None:
    frame = CoordinateFrame("hall", 0.01, QUARTER_ABOUT_Z, (10.0, 20.0, 30.0))
    np.testing.assert_allclose(frame.vectors(np.array([[100.0, 0, 5]])), [[0, 100, 5]], atol=1e-12)


@pytest.mark.parametrize("bits", ["7f800000", "ff800000", "7f800001", "7f7fffff", "ffffffff"])
def test_any_bits_are_converted_without_a_warning(bits: str) -> None:
    """Infinity, a signalling NaN, the largest number, and out of view; warnings are errors in tests."""
    values = np.frombuffer(bytes.fromhex(bits * 3), ">f4").reshape(1, 3)
    for frame in (CoordinateFrame("lab"), CoordinateFrame("hall", 1e6, QUARTER_ABOUT_Z, (1.0, 2.0, 3.0))):
        assert frame.points(values).shape == frame.vectors(values).shape == (1, 3)


def test_a_pose_has_the_rotated_position_and_orientation() -> None:
    frame = CoordinateFrame("hall", 0.01, QUARTER_ABOUT_Z, (10.0, 20.0, 30.0))
    [pose] = frame.poses(tools((1, 0, 0, 0, 100, 200, 300, 50)))
    assert pose == pytest.approx((8.0, 21.0, 33.0, 0.0, 0.0, HALF, HALF, 0.5))


def test_a_tool_with_any_value_that_is_no_number_is_out_of_view() -> None:
    """A pose is complete or missing, whether it is transformed or not."""
    for field in range(8):
        for value in (NAN, math.inf, -math.inf):
            values = [1.0, 0, 0, 0, 100, 200, 300, 0.5]
            values[field] = value
            for frame in (CoordinateFrame("lab"), CoordinateFrame("lab", 1e-3, QUARTER_ABOUT_Z)):
                assert frame.poses(tools(tuple(values))) == [None]


def test_a_position_beyond_a_float_is_out_of_view() -> None:
    assert CoordinateFrame("lab", 1000.0).poses(tools((1, 0, 0, 0, 3e38, 0, 0, 0))) == [None]


def test_a_quaternion_of_zeros_is_no_rotation() -> None:
    zeros = tools((0.0,) * 8)
    assert CoordinateFrame("lab").poses(zeros) == [None]
    assert CoordinateFrame("lab").poses(zeros, accept_zeros=True) == [(0.0,) * 8]
