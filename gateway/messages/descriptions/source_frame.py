"""The coordinate frame of a source's poses, from its settings and the server's parameters."""

import math
from typing import Final

from gateway.config.settings import SourceSettings
from gateway.config.values import RollPitchYaw
from gateway.messages.coordinate_frame import CoordinateFrame, Quaternion, product
from gateway.messages.encode import metres_per_unit
from gateway.rtc3d.parameters import Parameters

_Y_UP_TO_Z_UP: Final[Quaternion] = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
"""A quarter turn about x: (x, y, z) becomes (x, -z, y)."""

_ROUNDING_ERROR: Final = 1e-15


def source_frame(settings: SourceSettings, parameters: Parameters) -> CoordinateFrame:
    """Return the frame in which poses of a source are published; the unit is that of §6.2 if none is set."""
    transform = settings.transform
    unit = transform.units or parameters.length_unit
    metres = metres_per_unit(unit)
    rotation = transform.rotation_xyzw or quaternion_of(transform.rotation_deg)
    if transform.up == "y":
        rotation = product(rotation, _Y_UP_TO_Z_UP)
    return CoordinateFrame(
        settings.frame_id or settings.name,
        None if metres is None else metres * transform.scale,
        rotation,
        transform.translation_m,
        transform.scale,
    )


def unknown_unit_text(parameters: Parameters, what: str = "positions") -> str:
    """Return why no positions are published while the unit of length is unknown, and what to do."""
    return (
        f"unit of length {parameters.length_unit[:40]!r} is unknown: no {what} are published; set it to mm "
        "or m in the server, or set transform.units of the source in the configuration"
    )


def quaternion_of(angles: RollPitchYaw) -> Quaternion:
    """Return the rotation by roll about x, then pitch about y, then yaw about z, all of them fixed axes."""
    roll, pitch, yaw = (math.radians(angle) / 2 for angle in (angles.roll, angles.pitch, angles.yaw))
    about_x = (math.sin(roll), 0.0, 0.0, math.cos(roll))
    about_y = (0.0, math.sin(pitch), 0.0, math.cos(pitch))
    about_z = (0.0, 0.0, math.sin(yaw), math.cos(yaw))
    x, y, z, w = (
        # Without rounding errors such as that of the cosine of 90°, so that poses have 0 there, too.
        0.0 if abs(value) < _ROUNDING_ERROR else value
        for value in product(about_z, product(about_y, about_x))
    )
    return x, y, z, w
