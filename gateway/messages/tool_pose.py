"""Pose messages of single tools, in SI units, from a 6D component."""

import math
import struct
from collections.abc import Sequence
from typing import Final

import rtc3d

from gateway.messages.stamp import Stamp
from gateway.rtc3d.components import Component

_FINGERPRINT: Final[bytes] = rtc3d.tool_pose_t._get_packed_fingerprint()  # noqa: SLF001 - lcm-gen offers no other way
# Frame number, time stamp, visible, position, orientation, error.
_CONTENT: Final = struct.Struct(">iq?8f")
_METRES: Final = {"m": 1.0, "dm": 1e-1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "in": 0.0254}


def metres_per_unit(unit: str) -> float | None:
    """Return the length in metres of ``unit`` in the 3D parameters (§6.2); None if it is unknown."""
    return _METRES.get(unit.strip().lower() or "mm")


def tool_poses(
    component: Component, stamp: Stamp, sequences: Sequence[int], unit_m: float = 1e-3
) -> list[bytes]:
    """Return one ``tool_pose_t`` message per tool of a 6D component.

    Positions and errors are in metres; quaternions have the order x, y, z, w. ``sequences`` has one sequence
    number per tool. ``unit_m`` is the length of the component's unit in metres.
    """
    return [
        _FINGERPRINT + stamp.prefix(sequence) + _content(component, tool, unit_m)
        for tool, sequence in zip(component.items().tolist(), sequences, strict=True)
    ]


def _content(component: Component, tool: tuple[float, ...], unit_m: float) -> bytes:
    q0, qx, qy, qz, x, y, z, error = tool
    # Any NaN means missing (field note 7): a robot must never get an incomplete pose.
    visible = not any(map(math.isnan, tool))
    if visible:
        pose = (x * unit_m, y * unit_m, z * unit_m, qx, qy, qz, q0, error * unit_m)
    else:
        pose = (math.nan,) * 8
    return _CONTENT.pack(component.frame_number, component.timestamp_us, visible, *pose)
