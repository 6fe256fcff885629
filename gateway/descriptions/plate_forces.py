"""The forces on plates, in metres and newtons: where they act, and how large they are."""

import math
import re
from typing import Final, NamedTuple

from gateway.descriptions.force_plates import geometry_of
from gateway.descriptions.labels import describe
from gateway.messages.tool_pose import metres_per_unit
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters, Plate

METRES_PER_NEWTON: Final = 1e-3
"""The length of arrows: 1 m for 1000 N, so a person's weight is about as long as a leg."""

MIN_FORCE_N: Final = 10.0
"""Below this force on the surface, the centre of pressure is noise, and no arrow is drawn."""

_UNIT_OF_FORCE: Final = re.compile(r"\s*(k?)N\s*", re.IGNORECASE)
_UNIT_OF_MOMENT: Final = re.compile(r"\s*(k?)N\W?(\w+)\s*", re.IGNORECASE)

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
            continue
        x, y, z = geometry.corners.mean(axis=0).tolist()
        nx, ny, nz = geometry.rotation[:, 2].tolist()
        found.append(PlacedPlate(label, geometry.corners.tolist(), (x, y, z), (nx, ny, nz), *units_of(plate)))
    return found


def units_of(plate: Plate) -> tuple[float, float]:
    """Return the units of a plate's forces and moments, in N and in Nm; unknown ones count as N and Nm."""
    units = [channel.unit for channel in plate.channels]
    return _in_newtons(units[0] if units else ""), _in_newton_metres(units[3] if len(units) > 3 else "")


def _in_newtons(unit: str) -> float:
    match = _UNIT_OF_FORCE.fullmatch(unit)
    return 1000.0 if match and match[1] else 1.0


def _in_newton_metres(unit: str) -> float:
    match = _UNIT_OF_MOMENT.fullmatch(unit)
    if match is None:
        return 1.0
    return (1000.0 if match[1] else 1.0) * (metres_per_unit(match[2]) or 1.0)


def force_on(plate: PlacedPlate, load: tuple[float, ...]) -> PlateForce | None:
    """Return the force of a load (§7.5); None if it is too small or not known.

    The moments are about the centre of the surface. The force F acts at n × M / (n · F) from there, where n
    is the normal: about this point, the moment has no component within the surface.
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
