"""Pose messages of single tools, in metres and in the frame of the source, from a 6D component."""

import math
import struct
from collections.abc import Sequence
from typing import Final

import rtc3d

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.stamp import Stamp
from gateway.rtc3d.components import Component

_FINGERPRINT: Final[bytes] = rtc3d.tool_pose_t._get_packed_fingerprint()  # noqa: SLF001 - lcm-gen offers no other way
# Frame number, time stamp, visible, position, orientation, error.
_CONTENT: Final = struct.Struct(">iq?8f")
_NO_POSE: Final = (math.nan,) * 8
_UNITS: Final = {
    1.0: "m metre metres meter meters",
    1e-1: "dm decimetre decimetres decimeter decimeters",
    1e-2: "cm centimetre centimetres centimeter centimeters",
    1e-3: "mm millimetre millimetres millimeter millimeters",
    1e-6: "um µm microm micron microns micrometre micrometres micrometer micrometers",
    0.0254: "in inch inches",
    0.3048: "ft foot feet",
}
_METRES: Final = {name.casefold(): metres for metres, names in _UNITS.items() for name in names.split()}


def metres_per_unit(unit: str) -> float | None:
    """Return the length in metres of ``unit`` in the 3D parameters (§6.2); None if it is unknown."""
    return _METRES.get(unit.strip().casefold() or "mm")


def tool_poses(
    component: Component, stamp: Stamp, sequences: Sequence[int], frame: CoordinateFrame
) -> list[bytes]:
    """Return one ``tool_pose_t`` message per tool of a 6D component, with poses in ``frame``.

    Positions and errors are in metres; quaternions have the order x, y, z, w. ``sequences`` has one sequence
    number per tool. The unit of ``frame`` must be known.
    """
    head = (component.frame_number, component.timestamp_us)
    return [
        _FINGERPRINT
        + stamp.prefix(sequence)
        + (_CONTENT.pack(*head, False, *_NO_POSE) if pose is None else _CONTENT.pack(*head, True, *pose))
        for pose, sequence in zip(frame.poses(component.items(), accept_zeros=True), sequences, strict=True)
    ]
