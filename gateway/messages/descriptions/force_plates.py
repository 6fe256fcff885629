"""Force plates: which analog channels a plate has, where the forces on it act, and how large they are.

The Force component has the loads that the server has computed (§7.5). C3D has none: readers compute them from
analog channels by the plate's type (C3D user guide, FORCE_PLATFORM:TYPE). If that gives the recorded loads,
the plate refers to the server's own channels. Otherwise six channels are added, from which readers get them.
"""

import math
import re
from collections.abc import Iterable
from typing import Any, Final, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from gateway.messages.descriptions.labels import describe
from gateway.messages.encode import metres_per_unit
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters, ParametersAnalog, Plate, Point

Array: TypeAlias = npt.NDArray[Any]

FORCES_AND_MOMENTS: Final = 2
"""The type of plates whose six channels are Fx, Fy, Fz, Mx, My, Mz at the transducer's origin."""
EIGHT_FORCES: Final = 3
"""The type of plates (Kistler) with eight channels: Fx12, Fx34, Fy14, Fy23, Fz1, Fz2, Fz3, Fz4."""
CALIBRATED: Final = 4
"""As FORCES_AND_MOMENTS, after a multiplication by FORCE_PLATFORM:CAL_MATRIX."""

ADDED_LABELS: Final = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")

_TOLERANCE: Final = 1e-3
"""How much computed loads may differ from recorded ones, as a part of the largest."""


class PlateGeometry(NamedTuple):
    """Where a plate is, in the unit of the points.

    ``corners`` has the shape (4, 3) and ``origin`` (3,). ``rotation``, shape (3, 3), turns the plate's axes
    into those of the laboratory.
    """

    corners: Array
    origin: Array
    rotation: Array


def geometry_of(plate: Plate, unit: str) -> PlateGeometry | None:
    """Return a plate's geometry; None if its four corners are not known or not those of a rectangle."""
    if len(plate.corners) != 4:
        return None
    corners = np.array([_position(corner, unit) for corner in plate.corners])
    origin = np.zeros(3) if plate.origin is None else np.nan_to_num(_position(plate.origin, unit))
    x_axis, y_side = corners[0] - corners[1], corners[0] - corners[3]
    with np.errstate(over="ignore", invalid="ignore"):  # corners can be NaN, and any number by mistake
        z_axis = np.cross(x_axis, y_side)
        y_axis = np.cross(z_axis, x_axis)
        axes = np.stack([x_axis, y_axis, z_axis], axis=1)
        lengths = np.linalg.norm(axes, axis=0)
    if not np.isfinite(lengths).all() or not lengths.all():
        return None
    return PlateGeometry(corners, origin, axes / lengths)


def own_channels(plate: Plate, analog: ParametersAnalog | None) -> tuple[int, ...]:
    """Return the indices of a plate's analog channels; () if they are not known."""
    by_id = {channel.id: index for index, channel in enumerate(analog.channels if analog else ())}
    found = [by_id[channel_id] for channel_id in plate.analog_channel_ids if channel_id in by_id]
    return tuple(found) if len(found) == len(plate.analog_channel_ids) else ()


def possible_types(plate: Plate, num_channels: int) -> tuple[int, ...]:
    """Return the types that a plate with this many channels can have, the most likely one first."""
    if num_channels == 8:
        return (EIGHT_FORCES,)
    if num_channels != 6:
        return ()
    return (CALIBRATED, FORCES_AND_MOMENTS) if calibration_of(plate).any() else (FORCES_AND_MOMENTS,)


def calibration_of(plate: Plate) -> Array:
    """Return a plate's calibration matrix, shape (6, 6); zeros if it has none of this size."""
    rows = plate.calibration_matrix
    is_square = len(rows) == 6 and all(len(row) == 6 for row in rows)
    matrix = np.array(rows) if is_square else np.zeros((6, 6))
    return matrix if np.isfinite(matrix).all() else np.zeros((6, 6))


def loads_from_channels(plate_type: int, values: Array, calibration: Array, geometry: PlateGeometry) -> Array:
    """Return forces and moments in the laboratory's axes, shape (samples, 6), as readers compute them.

    ``values`` has the shape (samples, channels). Moments are about the centre of the plate's surface.
    """
    origin = _reader_origin(geometry.origin)
    if plate_type == EIGHT_FORCES:
        x12, x34, y14, y23, z1, z2, z3, z4 = values.T
        a, b, depth = origin
        force = np.stack([x12 + x34, y14 + y23, z1 + z2 + z3 + z4], axis=1)
        moment = np.stack(
            [b * (z1 + z2 - z3 - z4), a * (z2 + z3 - z1 - z4), b * (x34 - x12) + a * (y14 - y23)], axis=1
        )
        moment += np.cross(force, [0.0, 0.0, depth])
    else:
        if plate_type == CALIBRATED:
            values = values @ calibration.T
        force = values[:, :3]
        moment = values[:, 3:] + np.cross(force, origin)
    return np.concatenate([force @ geometry.rotation.T, moment @ geometry.rotation.T], axis=1)


def channels_from_loads(loads: Array, geometry: PlateGeometry) -> Array:
    """Return the six channels of a FORCES_AND_MOMENTS plate from which readers compute ``loads``.

    ``loads`` has the shape (samples, 6): forces and moments in the laboratory's axes, the moments about the
    centre of the plate's surface.
    """
    with np.errstate(invalid="ignore"):  # loads can be infinite
        force = loads[:, :3] @ geometry.rotation
        moment = loads[:, 3:] @ geometry.rotation - np.cross(force, _reader_origin(geometry.origin))
    return np.concatenate([force, moment], axis=1)


def is_equal(computed: Array, recorded: Array) -> bool:
    """Whether computed loads are those that were recorded, both of shape (samples, 6)."""
    computed, recorded = computed.reshape(-1, 2, 3), recorded.reshape(-1, 2, 3)  # forces, moments
    largest = np.maximum(abs(recorded), abs(computed)).max(axis=(0, 2), initial=0.0)
    difference = abs(computed - recorded).max(axis=(0, 2), initial=0.0)
    return bool((difference <= _TOLERANCE * np.maximum(largest, 1e-6)).all())


def moment_factor(plate: Plate, position_unit: str) -> float:
    """Return what turns a plate's moments into the product of the units of its forces and of positions.

    It is 1000 for N, Nm and mm; 1 if the unit of moments or positions is unknown or missing.
    """
    newton_metres, metres = _newton_metres(plate), metres_per_unit(position_unit)
    return newton_metres / units_of(plate)[0] / metres if newton_metres and metres else 1.0


def _position(point: Point, unit: str) -> Array:
    return np.array([point.x, point.y, point.z]) * _length_factor(point.unit, unit)


def _length_factor(unit: str, wanted: str) -> float:
    """Return the factor from one unit of length to another; 1 if one of them is unknown or missing."""
    from_m, to_m = (metres_per_unit(name) if name.strip() else None for name in (unit, wanted))
    return from_m / to_m if from_m and to_m else 1.0


def _reader_origin(origin: Array) -> Array:
    """Return the origin as readers take it: below the surface, so with a negative z (user guide, ORIGIN)."""
    return -origin if origin[2] > 0 else origin


METRES_PER_NEWTON: Final = 1e-3
"""The length of arrows: 1 m for 1000 N, so a person's weight is about as long as a leg."""

MIN_FORCE_N: Final = 10.0
"""Below this force on the surface, the centre of pressure is noise, and no arrow is drawn."""

_UNIT_OF_FORCE: Final = re.compile(r"(k?)N", re.IGNORECASE)
_UNIT_OF_MOMENT: Final = re.compile(r"(k?)N\W?(\w+)", re.IGNORECASE)

Vector = tuple[float, float, float]


class PlacedPlate(NamedTuple):
    """A plate in metres and newtons. ``centre`` and ``normal`` are those of its surface.

    ``newtons`` and ``newton_metres`` are the units of its forces and moments.
    """

    label: str
    corners: list[list[float]]
    centre: Vector
    normal: Vector
    newtons: float
    newton_metres: float


class PlateForce(NamedTuple):
    """A force in newtons and the centre of pressure, where it acts, in metres."""

    position: Vector
    force: Vector


def placed_plates(parameters: Parameters) -> list[PlacedPlate | None]:
    """Return the plates in the order of the parameters; None for one without a known place."""
    plates = parameters.force.plates if parameters.force else ()
    labels = describe(ComponentType.FORCE, parameters, len(plates)).labels
    found: list[PlacedPlate | None] = []
    for label, plate in zip(labels, plates, strict=True):
        geometry = geometry_of(plate, "m")
        if geometry is None:
            found.append(None)
        else:
            centre, normal = geometry.corners.mean(axis=0).tolist(), geometry.rotation[:, 2].tolist()
            corners = geometry.corners.tolist()
            found.append(PlacedPlate(label, corners, tuple(centre), tuple(normal), *units_of(plate)))
    return found


UpAxis: TypeAlias = Literal["x", "y", "z"]

_VERTICAL: Final = 0.95
"""The cosine from which a plate counts as horizontal."""


def up_axis_of(parameters: Iterable[Parameters]) -> UpAxis | None:
    """Return the axis that points up, by the plates: people step on them; None if they do not show it."""
    found: set[UpAxis] = set()
    for each in parameters:
        for plate in placed_plates(each):
            if plate is not None:
                by_size = zip(get_args(UpAxis), map(abs, plate.normal), strict=True)
                found |= {axis for axis, part in by_size if part > _VERTICAL}
    return found.pop() if len(found) == 1 else None


def units_of(plate: Plate) -> tuple[float, float]:
    """Return the units of a plate's forces and moments, in N and in Nm; unknown ones count as N and Nm."""
    return _newtons(plate) or 1.0, _newton_metres(plate) or 1.0


def unknown_units(plate: Plate) -> list[str]:
    """Return the units of a plate's forces and moments that are given, but not known."""
    found = ((_unit(plate, 0), _newtons(plate)), (_unit(plate, _FIRST_MOMENT), _newton_metres(plate)))
    return [unit for unit, factor in found if unit and factor is None]


_FIRST_MOMENT: Final = 3


def _unit(plate: Plate, channel: int) -> str:
    return plate.channels[channel].unit.strip() if channel < len(plate.channels) else ""


def _newtons(plate: Plate) -> float | None:
    match = _UNIT_OF_FORCE.fullmatch(_unit(plate, 0))
    return (1000.0 if match[1] else 1.0) if match else None


def _newton_metres(plate: Plate) -> float | None:
    match = _UNIT_OF_MOMENT.fullmatch(_unit(plate, _FIRST_MOMENT))
    metres = metres_per_unit(match[2]) if match else None
    return metres * (1000.0 if match[1] else 1.0) if match and metres else None


def force_on(plate: PlacedPlate, load: tuple[float, ...]) -> PlateForce | None:
    """Return the force of a load (§7.5); None if it is too small or not known.

    The moments are about the centre of the surface. The force F acts at n × M / (n · F) from there, where n
    is the normal: about this point, the moment has no component within the surface.

    Either sign counts, and a single sample: a live view knows neither whether the server sends the force on
    the plate or that on the person, nor what follows. Exports for OpenSim find both in the whole take.
    """
    fx, fy, fz, mx, my, mz = load
    nx, ny, nz = plate.normal
    normal_force = (nx * fx + ny * fy + nz * fz) * plate.newtons
    if not (abs(normal_force) >= MIN_FORCE_N and all(map(math.isfinite, load))):
        return None
    factor = plate.newton_metres / normal_force
    x, y, z = plate.centre
    position = (
        x + (ny * mz - nz * my) * factor,
        y + (nz * mx - nx * mz) * factor,
        z + (nx * my - ny * mx) * factor,
    )
    return PlateForce(position, (fx * plate.newtons, fy * plate.newtons, fz * plate.newtons))


class GroundReactions(NamedTuple):
    """What a plate does to what stands on it, in N, m and Nm; each has the shape (samples, 3).

    ``free_moments`` are about the normal of the surface, at the centre of pressure.
    """

    forces: Array
    positions: Array
    free_moments: Array


def ground_reactions(
    loads: Array, normal: Array, centre: Array, min_force_n: float = MIN_FORCE_N
) -> GroundReactions:
    """Return the forces of loads, shape (samples, 6), in N and Nm, as ``force_on`` does for one.

    ``normal`` and ``centre`` are those of the surface. Below ``min_force_n`` at a right angle to the surface,
    or if the load is not known, there is no contact: forces and moments are 0, and the position is the
    centre.
    """
    forces, moments = loads[:, :3], loads[:, 3:]
    with np.errstate(invalid="ignore"):  # loads can be infinite
        normal_forces = forces @ normal
    has_contact = np.isfinite(loads).all(axis=1) & (abs(normal_forces) >= min_force_n) & (normal_forces != 0)
    forces, moments = (np.where(has_contact[:, None], values, 0.0) for values in (forces, moments))
    divisors = np.where(has_contact, normal_forces, 1.0)[:, None]
    arms = np.cross(normal, moments) / divisors
    about_normal = (moments - np.cross(arms, forces)) @ normal
    return GroundReactions(forces, centre + arms, about_normal[:, None] * normal)
