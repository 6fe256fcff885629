"""The section ``transform`` of a source: from the server's units and axes to those of the lab."""

import math
from typing import Annotated, Final, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from gateway.config.section import Section, expects, validation_error

_MAX_NORM_ERROR: Final = 0.01  # quaternions are often written with two or three digits

_Number = Annotated[
    float,
    Field(strict=True, ge=-1e6, le=1e6, allow_inf_nan=False),
    expects("a number from -1000000 to 1000000"),
]


def _has_items(count: int) -> BeforeValidator:
    """Return an annotation that refuses lists of another length as a whole."""

    def check(value: object) -> object:
        if isinstance(value, list | tuple) and len(value) != count:
            raise ValueError
        return value

    return BeforeValidator(check)


def _unit_quaternion(values: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    norm = math.hypot(*values)
    if not norm:
        raise validation_error("found only zeros, which is no rotation; expected [0, 0, 0, 1] for none")
    x, y, z, w = (value / norm for value in values)
    if abs(norm - 1) > _MAX_NORM_ERROR:
        found, expected = ([f"{number:.4g}" for number in numbers] for numbers in (values, (x, y, z, w)))
        raise validation_error(
            f"found [{', '.join(found)}], whose squares do not add up to 1; "
            f"expected x y z w, such as [{', '.join(expected)}]"
        )
    return (x, y, z, w)


_ANGLE: Final = expects("a number of degrees from -360 to 360")
Degrees = Annotated[float, Field(strict=True, ge=-360, le=360, allow_inf_nan=False), _ANGLE]
Unit = Annotated[
    Literal["m", "dm", "cm", "mm", "um", "in", "ft"],
    expects("m, dm, cm, mm, um, in or ft, or null for the server's"),
]
Scale = Annotated[
    float,
    Field(strict=True, ge=1e-6, le=1e6, allow_inf_nan=False),
    expects("a number from 0.000001 to 1000000"),
]
UpAxis = Annotated[Literal["y", "z"], expects("y or z")]
QuaternionXyzw = Annotated[
    tuple[_Number, _Number, _Number, _Number],
    _has_items(4),
    expects("a list of four numbers, x y z w, such as [0, 0, 0, 1]"),
    AfterValidator(_unit_quaternion),
]
Metres3 = Annotated[
    tuple[_Number, _Number, _Number],
    _has_items(3),
    expects("a list of three numbers of metres, x y z, such as [2.5, 0, 0]"),
]


class RollPitchYaw(Section):
    """A rotation as angles about the fixed axes: first roll about x, then pitch about y, then yaw about z."""

    roll: Degrees = 0.0
    """The angle about x, in degrees."""

    pitch: Degrees = 0.0
    """The angle about y, in degrees."""

    yaw: Degrees = 0.0
    """The angle about z, in degrees."""


class TransformSettings(Section):
    """From the server's units and axes to the frame of poses: units, scale, up, rotation, translation.

    They are applied in this order.
    """

    units: Unit | None = None
    """The server's unit of length, if its parameters give a wrong one or none. null means as they say."""

    scale: Scale = 1.0
    """A factor for all positions."""

    up: UpAxis = "z"
    """The axis of the server that points up. With y, the axes are turned so that z points up."""

    rotation_xyzw: QuaternionXyzw | None = None
    """The rotation after `up`, as a quaternion."""

    rotation_deg: RollPitchYaw = RollPitchYaw()
    """The rotation after `up`, as angles. Only one of the two can be given."""

    translation_m: Metres3 = (0.0, 0.0, 0.0)
    """Where the server's origin is in the frame of the lab, in metres."""

    @model_validator(mode="after")
    def _check_rotation(self) -> Self:
        if self.rotation_xyzw is not None and self.rotation_deg != RollPitchYaw():
            raise validation_error("found rotation_xyzw, too; expected one of the two", "rotation_deg")
        return self
