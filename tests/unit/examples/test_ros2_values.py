"""What examples/ros2_values.py makes of the gateway's messages, against numbers worked out by hand."""

import importlib.util
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rtc3d

EXAMPLE = Path(__file__).parents[3] / "examples/ros2_values.py"
CAPTURE_UTIME = 1_780_000_000_123_456


@pytest.fixture(scope="module")
def ros2_values() -> Any:
    spec = importlib.util.spec_from_file_location("ros2_values", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def tool_pose(*, visible: bool) -> bytes:
    message = rtc3d.tool_pose_t()
    message.capture_utime, message.visible = CAPTURE_UTIME, visible
    message.position_m = [0.5, -0.25, 1.5]
    message.orientation_xyzw = [0.0, 0.0, 1.0, 0.0]
    return bytes(message.encode())


def test_a_pose_is_as_ros_wants_it(ros2_values: Any) -> None:
    pose = ros2_values.pose(tool_pose(visible=True))
    assert pose.stamp == (1_780_000_000, 123_456_000)
    assert pose.position_m == (0.5, -0.25, 1.5)
    assert pose.orientation_xyzw == (0.0, 0.0, 1.0, 0.0)


def test_a_tool_out_of_view_has_no_pose(ros2_values: Any) -> None:
    assert ros2_values.pose(tool_pose(visible=False)) is None


def test_markers_are_points_in_metres_each_in_its_place(ros2_values: Any) -> None:
    message = rtc3d.markers_t()
    message.capture_utime = CAPTURE_UTIME
    for x, y, z in ((1000.0, -500.0, 250.0), (math.nan, math.nan, math.nan), (2.0, 4.0, 8.0)):
        marker = rtc3d.marker_t()
        marker.x, marker.y, marker.z, marker.reliability = x, y, z, 0.1
        message.markers.append(marker)
    message.num_markers = 3
    cloud = ros2_values.cloud(message.encode())
    assert (cloud.stamp, cloud.width) == ((1_780_000_000, 123_456_000), 3)
    points = np.frombuffer(cloud.data, "<f4").reshape(3, 3)
    assert points[0] == pytest.approx([1.0, -0.5, 0.25])
    assert np.isnan(points[1]).all()
    assert points[2] == pytest.approx([0.002, 0.004, 0.008])


def test_a_frame_without_markers_is_an_empty_cloud(ros2_values: Any) -> None:
    assert ros2_values.cloud(rtc3d.markers_t().encode())[1:] == (0, b"")
