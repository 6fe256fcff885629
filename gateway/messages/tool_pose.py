"""6D component → one pose message per tool, in SI units."""

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
    """Return the length of one ``unit`` of the 3D parameters in metres (§6.2); None for an unknown unit."""
    return _METRES.get(unit.strip().lower() or "mm")


def tool_poses(
    component: Component, stamp: Stamp, sequences: Sequence[int], metres: float = 1e-3
) -> list[bytes]:
    """Return one ``tool_pose_t`` message per tool of a 6D component.

    Positions and errors are in metres; quaternions are in the order x, y, z, w. ``sequences`` holds one
    sequence number per tool; ``metres`` is the length of the component's unit.
    """
    return [
        _FINGERPRINT + stamp.prefix(sequence) + _content(component, tool, metres)
        for tool, sequence in zip(component.items().tolist(), sequences, strict=True)
    ]


def _content(component: Component, tool: tuple[float, ...], metres: float) -> bytes:
    q0, qx, qy, qz, x, y, z, error = tool
    # Any NaN means missing (field note 7): a robot must never get half a pose.
    visible = not any(map(math.isnan, tool))
    if visible:
        pose = (x * metres, y * metres, z * metres, qx, qy, qz, q0, error * metres)
    else:
        pose = (math.nan,) * 8
    return _CONTENT.pack(component.frame_number, component.timestamp_us, visible, *pose)
