"""The transform of a source, compared with matrices that are written down here from its description."""

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from hypothesis import given
from hypothesis import strategies as st

from gateway.config.settings import SourceSettings
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.descriptions.source_frame import source_frame
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType
from gateway.rtc3d.parameters import Parameters

Matrix = npt.NDArray[np.float64]

METRES = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "um": 1e-6, "in": 0.0254}
Y_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])

angles = st.floats(-360, 360) | st.sampled_from([-90.0, 90.0, 180.0, 270.0])
rotations = st.fixed_dictionaries({}, optional={"roll": angles, "pitch": angles, "yaw": angles})
transforms = st.fixed_dictionaries(
    {},
    optional={
        "units": st.sampled_from(sorted(METRES)),
        "scale": st.floats(0.001, 1000),
        "up": st.sampled_from(["y", "z"]),
        "rotation_deg": rotations,
        "translation_m": st.lists(st.floats(-100, 100), min_size=3, max_size=3),
    },
)
positions = st.tuples(*3 * [st.floats(-10_000, 10_000, width=32)])
quaternions = (
    st.tuples(*4 * [st.floats(-1, 1)])
    .filter(lambda values: math.hypot(*values) > 0.1)
    .map(lambda values: tuple(value / math.hypot(*values) for value in values))
)


def about(axis: int, degrees: float) -> Matrix:
    """Return the rotation about an axis, counterclockwise as seen from its tip."""
    sine, cosine = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    after, before = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[after, after] = matrix[before, before] = cosine
    matrix[after, before], matrix[before, after] = -sine, sine
    return matrix


def of_quaternion(x: float, y: float, z: float, w: float) -> Matrix:
    """Return exp(K), where K is the cross product with the rotation vector (Rodrigues' formula)."""
    length = math.hypot(x, y, z)
    angle = 2 * math.atan2(length, w)
    if not length:
        return np.eye(3)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) / length
    rotation: Matrix = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return rotation


def expected(transform: dict[str, Any]) -> tuple[float, Matrix, Matrix]:
    """Return the factor, the rotation and the translation, by the description of the keys."""
    factor = METRES[transform.get("units", "mm")] * transform.get("scale", 1.0)
    angle = transform.get("rotation_deg", {})
    fixed = about(2, angle.get("yaw", 0)) @ about(1, angle.get("pitch", 0)) @ about(0, angle.get("roll", 0))
    rotation = fixed @ (Y_UP if transform.get("up") == "y" else np.eye(3))
    return factor, rotation, np.array(transform.get("translation_m", [0, 0, 0]), float)


def frame_of(**transform: Any) -> CoordinateFrame:
    settings = {"name": "lab", "host": "192.0.2.20", "transform": transform}
    return source_frame(SourceSettings.model_validate(settings), Parameters())


@given(transforms, st.lists(positions, min_size=1, max_size=3))
def test_positions_are_scaled_turned_up_rotated_and_moved_in_this_order(
    transform: dict[str, Any], points: list[tuple[float, float, float]]
) -> None:
    factor, rotation, translation = expected(transform)
    found = frame_of(**transform).points(np.array(points))
    scale = max(1.0, factor)
    for point, given_point in zip(found, points, strict=True):
        np.testing.assert_allclose(
            point, rotation @ (factor * np.array(given_point)) + translation, rtol=1e-9, atol=1e-8 * scale
        )


@given(transforms, positions, quaternions)
def test_a_tool_keeps_its_shape_and_moves_with_its_frame(
    transform: dict[str, Any], position: tuple[float, float, float], tool: tuple[float, float, float, float]
) -> None:
    factor, rotation, translation = expected(transform)
    x, y, z, w = tool
    item = np.array([(w, x, y, z, *position, 1.0)], ITEM_DTYPES[ComponentType.TOOLS].newbyteorder(">"))
    [pose] = frame_of(**transform).poses(item)
    assert pose is not None
    scale = max(1.0, factor)
    np.testing.assert_allclose(
        pose[:3], rotation @ (factor * np.array(position)) + translation, rtol=1e-9, atol=1e-8 * scale
    )
    np.testing.assert_allclose(of_quaternion(*pose[3:7]), rotation @ of_quaternion(*tool), atol=1e-6)
    assert abs(math.hypot(*pose[3:7]) - 1) < 1e-6
    assert abs(pose[7] - factor) <= 1e-9 * factor


@given(transforms.filter(lambda transform: "rotation_deg" not in transform), quaternions)
def test_a_rotation_as_a_quaternion_follows_up(
    transform: dict[str, Any], quaternion: tuple[float, float, float, float]
) -> None:
    _, turned_up, _ = expected(transform)
    frame = frame_of(**transform, rotation_xyzw=list(quaternion))
    rotation = of_quaternion(*quaternion) @ turned_up
    np.testing.assert_allclose(frame.vectors(np.eye(3)), rotation.T, atol=1e-9)
    np.testing.assert_allclose(of_quaternion(*frame.rotation_xyzw), rotation, atol=1e-9)
    assert np.linalg.det(frame.matrix) > 0  # never mirrored
