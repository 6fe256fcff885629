import math
import struct
from itertools import chain
from typing import Any

import pytest
import rtc3d

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.stamp import Stamp
from gateway.messages.tool_pose import metres_per_unit, tool_poses
from gateway.rtc3d.components import Component
from gateway.rtc3d.frames import split_frame
from tests.unit.messages.samples import received
from tests.vectors import ALL_ONES, TOOLS, ByteOrder

STAMP = Stamp(
    utime=1_700_000_000_000_001, capture_utime=1_700_000_000_000_000, session=3, parameters_version=5
)
SEQUENCE = 41
FRAME = CoordinateFrame("lab")
# fingerprint, utime, capture_utime, sequence, session, parameters version, frame number, time stamp, visible,
# pose and error
POSE = struct.Struct(">8sqqqiiiqb8f")
NAN = math.nan

both_orders = pytest.mark.parametrize("order", ["big", "little"])


def tools(*poses: tuple[float, ...]) -> Component:
    """Return a 6D component; each tool has q0, qx, qy, qz, x, y, z, error."""
    wire = struct.pack(">IIiqI", 24 + 32 * len(poses), 4, 4, 7500, len(poses))
    wire += struct.pack(f">{8 * len(poses)}f", *chain.from_iterable(poses))
    (component,) = split_frame(struct.pack(">I", 1) + wire, "big").components
    return component


def pose_of(component: Component, unit_m: float = 1e-3) -> Any:
    [message] = tool_poses(component, STAMP, [SEQUENCE], CoordinateFrame("lab", unit_m))
    return rtc3d.tool_pose_t.decode(message)


@both_orders
def test_poses_are_in_metres_and_have_the_scalar_last(order: ByteOrder) -> None:
    fingerprint = rtc3d.tool_pose_t._get_packed_fingerprint()
    stamp = (1_700_000_000_000_001, 1_700_000_000_000_000)
    visible, missing = tool_poses(received(TOOLS, order), STAMP, [41, 7], FRAME)
    assert visible == POSE.pack(
        fingerprint, *stamp, 41, 3, 5, 4, 7500, 1,
        0.1, -0.2, 1.6,
        *struct.unpack(">4f", bytes.fromhex("BECCCCCD 3ECCCCCD 3E4CCCCD 3F4CCCCD")),
        0.000125,
    )  # fmt: skip
    assert missing == POSE.pack(fingerprint, *stamp, 7, 3, 5, 4, 7500, 0, *8 * [NAN])


def test_any_nan_makes_the_whole_pose_missing() -> None:
    """A robot must never get a part of a pose; zeros are a valid one."""
    for field in range(8):
        for nan in (NAN, ALL_ONES):
            values = [1.0, 0.0, 0.0, 0.0, 100.0, 200.0, 300.0, 0.5]
            values[field] = nan
            pose = pose_of(tools(tuple(values)))
            assert not pose.visible
            assert all(map(math.isnan, (*pose.position_m, *pose.orientation_xyzw, pose.error_m)))
    pose = pose_of(tools((0.0,) * 8))
    assert pose.visible
    assert (*pose.position_m, *pose.orientation_xyzw, pose.error_m) == (0.0,) * 8


def test_a_component_in_metres_is_not_scaled() -> None:
    pose = pose_of(tools((1.0, 0.0, 0.0, 0.0, 1.5, -2.0, 0.25, 0.0625)), unit_m=1.0)
    assert (pose.position_m, pose.error_m) == ((1.5, -2.0, 0.25), 0.0625)


def test_a_component_without_tools_gives_no_poses() -> None:
    assert tool_poses(tools(), STAMP, [], FRAME) == []


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        ("mm", 0.001),
        (" MM ", 0.001),
        ("", 0.001),  # the default of §6.2
        ("m", 1.0),
        ("cm", 0.01),
        ("um", 1e-6),
        ("µm", 1e-6),
        ("in", 0.0254),
        ("furlong", None),
    ],
)
def test_units_of_length_convert_to_metres(unit: str, metres: float | None) -> None:
    assert metres_per_unit(unit) == metres
