"""The values of LSL samples, by hand."""

import math
from typing import Any

import numpy as np
import pytest

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.outputs.lsl.samples import samples
from gateway.rtc3d.components import ITEM_DTYPES, MISSING, ComponentType

NAN = math.nan
PLAIN = CoordinateFrame("lab")
HALF_TURN = CoordinateFrame("world", 1e-3, (0.0, 0.0, 1.0, 0.0), (10.0, 0.0, 0.0))
"""Half a turn about z: x and y change their signs. Then 10 m along x."""


def rows(component: ComponentType, items: list[Any], frame: CoordinateFrame, num_items: int) -> list[Any]:
    """Return the one sample of a frame with these items."""
    array = np.array([items], np.float32).reshape(1, len(items), -1)
    [row] = samples(component, array, frame, num_items).tolist()
    assert isinstance(row, list)
    return row


def same(found: list[float], expected: list[float]) -> bool:
    return found == pytest.approx(expected, rel=1e-6, nan_ok=True)


def test_markers_are_in_metres_and_keep_their_reliability() -> None:
    found = rows(ComponentType.MARKERS, [(1000, -2000, 500, 0.25)], PLAIN, 1)
    assert same(found, [1.0, -2.0, 0.5, 0.25])


def test_markers_are_in_the_frame_of_the_source() -> None:
    found = rows(ComponentType.MARKERS, [(1000, 2000, 500, 0.25)], HALF_TURN, 1)
    assert same(found, [9.0, -2.0, 0.5, 0.25])


def test_a_missing_marker_is_nan_also_in_its_reliability() -> None:
    missing = (float(MISSING), float(MISSING), float(MISSING), 999.0)
    found = rows(ComponentType.MARKERS, [missing, (0, 0, 0, 0.5)], HALF_TURN, 2)
    assert same(found, [NAN, NAN, NAN, NAN, 10.0, 0.0, 0.0, 0.5])


def test_a_marker_without_one_coordinate_is_missing() -> None:
    assert same(rows(ComponentType.MARKERS, [(1, NAN, 3, 0.5)], PLAIN, 1), [NAN] * 4)


@pytest.mark.parametrize("x", [math.inf, -math.inf, 3.4e38])
def test_a_marker_that_a_float_cannot_hold_is_missing(x: float) -> None:
    frame = CoordinateFrame("lab", 10.0)
    assert same(rows(ComponentType.MARKERS, [(x, 0, 0, 0.5)], frame, 1), [NAN] * 4)


def test_tools_are_in_metres_with_the_quaternion_as_x_y_z_w() -> None:
    found = rows(ComponentType.TOOLS, [(0.5, 0.1, 0.2, 0.3, 1000, 2000, 3000, 2)], PLAIN, 1)
    assert same(found, [1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.5, 0.002])


def test_tools_are_turned_with_the_frame() -> None:
    """Half a turn about z after no rotation is half a turn about z."""
    found = rows(ComponentType.TOOLS, [(1, 0, 0, 0, 1000, 2000, 3000, 2)], HALF_TURN, 1)
    assert same(found, [9.0, -2.0, 3.0, 0.0, 0.0, 1.0, 0.0, 0.002])


@pytest.mark.parametrize("frame", [PLAIN, HALF_TURN])
def test_tools_are_as_the_poses_of_the_frame(frame: CoordinateFrame) -> None:
    """The same values as on all other outputs."""
    random = np.random.default_rng(1)
    items = random.normal(0, 500, (20, 8)).astype(np.float32)
    items[3, 5] = NAN
    items[4, :4] = 0
    found = samples(ComponentType.TOOLS, items.reshape(1, 20, 8), frame, 20).reshape(20, 8)
    tools = items.copy().view(ITEM_DTYPES[ComponentType.TOOLS].newbyteorder("=")).reshape(20)
    for row, pose in zip(found.tolist(), frame.poses(tools), strict=True):
        assert same(row, [NAN] * 8 if pose is None else list(pose))


def test_a_tool_out_of_view_is_nan() -> None:
    assert same(rows(ComponentType.TOOLS, [(float(MISSING),) * 8], HALF_TURN, 1), [NAN] * 8)


def test_forces_are_turned_but_not_moved_or_scaled() -> None:
    found = rows(ComponentType.FORCE, [(10, 20, 30, 40, 50, 60)], HALF_TURN, 1)
    assert same(found, [-10, -20, 30, -40, -50, 60])


def test_analog_values_stay_as_they_are() -> None:
    assert same(rows(ComponentType.ANALOG, [1.5, -2e9, NAN], HALF_TURN, 3), [1.5, -2e9, NAN])


def test_items_that_a_frame_lacks_are_nan() -> None:
    assert same(rows(ComponentType.ANALOG, [1, 2], PLAIN, 4), [1, 2, NAN, NAN])


def test_several_frames_are_several_samples() -> None:
    items = np.arange(6, dtype=np.float32).reshape(3, 2, 1)
    found = samples(ComponentType.ANALOG, items, PLAIN, 2)
    assert found.dtype == np.float32
    assert found.tolist() == [[0, 1], [2, 3], [4, 5]]
