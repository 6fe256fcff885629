"""Force plates in Foxglove's 3D scene: their outlines, and an arrow for each force."""

import math
import re
from typing import Final, NamedTuple

from foxglove.messages import (
    ArrowPrimitive,
    Color,
    Duration,
    LinePrimitive,
    LinePrimitiveLineType,
    Point3,
    Pose,
    Quaternion,
    SceneEntity,
    SceneEntityDeletion,
    SceneEntityDeletionType,
    SceneUpdate,
    TextPrimitive,
    Vector3,
)

from gateway.export.force_plates import geometry_of
from gateway.export.foxglove_topics import FoxgloveMessage, timestamp, topic_of
from gateway.messages.tool_pose import metres_per_unit
from gateway.rtc3d.components import ComponentType, Items
from gateway.rtc3d.parameters import Parameters
from gateway.takes.labels import describe

METRES_PER_NEWTON: Final = 1e-3
"""The length of arrows: 1 m for 1000 N, so a person's weight is about as long as a leg."""

MIN_FORCE_N: Final = 10.0
"""Below this force on the surface, the centre of pressure is noise, and no arrow is drawn."""

_UNIT_OF_FORCE: Final = re.compile(r"\s*(k?)N\s*", re.IGNORECASE)
_UNIT_OF_MOMENT: Final = re.compile(r"\s*(k?)N\W?(\w+)\s*", re.IGNORECASE)

_ARROW_COLOR: Final = Color(r=1.0, g=0.75, b=0.1, a=1.0)
_PLATE_COLOR: Final = Color(r=0.6, g=0.6, b=0.65, a=1.0)
_LINE_M: Final = 0.005
_TEXT_M: Final = 0.05
_SHAFT_M: Final = 0.015
_HEAD_M: Final = 0.04

_LIFETIME: Final = Duration(1)
"""An arrow disappears if no other message comes for this many seconds."""

_Vector = tuple[float, float, float]


class _Plate(NamedTuple):
    """A plate in metres and newtons. ``centre`` and ``normal`` are those of its surface."""

    label: str
    corners: list[list[float]]
    centre: _Vector
    normal: _Vector
    newtons: float
    newton_metres: float


class ForceScene:
    """The plates of one source and the forces on them. Plates without a known place are not drawn."""

    def __init__(self, source: str, parameters: Parameters) -> None:
        self._source = source
        self._plates = _plates(parameters)
        self._outlines = topic_of(f"/{source}/plates", SceneUpdate)
        self._arrows = topic_of(f"/{source}/forces", SceneUpdate)

    def plates(self, utime: int) -> FoxgloveMessage:
        """Return the outlines and labels of the plates, in place of all earlier ones."""
        time = timestamp(utime)
        update = SceneUpdate(
            deletions=[SceneEntityDeletion(timestamp=time, type=SceneEntityDeletionType.All)],
            entities=[
                SceneEntity(
                    timestamp=time,
                    frame_id=self._source,
                    id=plate.label,
                    lines=[_outline(plate)],
                    texts=[_text(plate)],
                )
                for plate in self._plates
                if plate is not None
            ],
        )
        return FoxgloveMessage(self._outlines, utime, update.encode())

    def arrows(self, items: Items, utime: int) -> FoxgloveMessage:
        """Return an arrow from each centre of pressure; ``items`` are those of the Force component."""
        time = timestamp(utime)
        entities = [
            # An entity without an arrow removes the one before.
            SceneEntity(
                timestamp=time,
                frame_id=self._source,
                id=plate.label,
                lifetime=_LIFETIME,
                arrows=_arrow(plate, load),
            )
            for plate, load in zip(self._plates, items.tolist(), strict=False)
            if plate is not None
        ]
        return FoxgloveMessage(self._arrows, utime, SceneUpdate(entities=entities).encode())


def _plates(parameters: Parameters) -> list[_Plate | None]:
    """Return the plates in the order of the parameters; None for one without a known place."""
    plates = parameters.force.plates if parameters.force else ()
    labels = describe(ComponentType.FORCE, parameters, len(plates)).labels
    found: list[_Plate | None] = []
    for label, plate in zip(labels, plates, strict=True):
        geometry = geometry_of(plate, "m")
        if geometry is None:
            found.append(None)
            continue
        units = [channel.unit for channel in plate.channels]
        newtons = _newtons(units[0] if units else "")
        x, y, z = geometry.corners.mean(axis=0).tolist()
        nx, ny, nz = geometry.rotation[:, 2].tolist()
        newton_metres = _newton_metres(units[3] if len(units) > 3 else "")
        found.append(
            _Plate(label, geometry.corners.tolist(), (x, y, z), (nx, ny, nz), newtons, newton_metres)
        )
    return found


def _newtons(unit: str) -> float:
    """Return a unit of force in N; an unknown one counts as N."""
    match = _UNIT_OF_FORCE.fullmatch(unit)
    return 1000.0 if match and match[1] else 1.0


def _newton_metres(unit: str) -> float:
    """Return a unit of moments in Nm; an unknown one counts as Nm."""
    match = _UNIT_OF_MOMENT.fullmatch(unit)
    if match is None:
        return 1.0
    return (1000.0 if match[1] else 1.0) * (metres_per_unit(match[2]) or 1.0)


def _arrow(plate: _Plate, load: tuple[float, ...]) -> list[ArrowPrimitive]:
    """Return the arrow of a load (§7.5); [] if it is too small or not known.

    The moments are about the centre of the surface. The force F acts at n × M / (n · F) from there, where n
    is the normal: about this point, the moment has no component within the surface.
    """
    fx, fy, fz, mx, my, mz = load
    nx, ny, nz = plate.normal
    normal_force = (nx * fx + ny * fy + nz * fz) * plate.newtons
    if not (abs(normal_force) >= MIN_FORCE_N and all(map(math.isfinite, load))):
        return []
    factor = plate.newton_metres / normal_force
    x, y, z = plate.centre
    position = Vector3(
        x=x + (ny * mz - nz * my) * factor,
        y=y + (nz * mx - nx * mz) * factor,
        z=z + (nx * my - ny * mx) * factor,
    )
    force = math.hypot(fx, fy, fz)
    length = force * plate.newtons * METRES_PER_NEWTON
    head = min(_HEAD_M, length / 2)
    return [
        ArrowPrimitive(
            pose=Pose(position=position, orientation=_from_x_axis(fx / force, fy / force, fz / force)),
            shaft_length=length - head,
            shaft_diameter=_SHAFT_M,
            head_length=head,
            head_diameter=_HEAD_M,
            color=_ARROW_COLOR,
        )
    ]


def _from_x_axis(x: float, y: float, z: float) -> Quaternion:
    """Return the shortest rotation from the x-axis to a direction of length 1."""
    w = 1.0 + x
    if w < 1e-9:
        return Quaternion(x=0.0, y=0.0, z=1.0, w=0.0)
    length = math.sqrt(w * w + y * y + z * z)
    return Quaternion(x=0.0, y=-z / length, z=y / length, w=w / length)


def _outline(plate: _Plate) -> LinePrimitive:
    return LinePrimitive(
        type=LinePrimitiveLineType.LineLoop,
        pose=Pose(position=Vector3(), orientation=Quaternion(w=1.0)),
        thickness=_LINE_M,
        points=[Point3(x=x, y=y, z=z) for x, y, z in plate.corners],
        color=_PLATE_COLOR,
    )


def _text(plate: _Plate) -> TextPrimitive:
    x, y, z = plate.centre
    return TextPrimitive(
        pose=Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(w=1.0)),
        billboard=True,
        font_size=_TEXT_M,
        color=_PLATE_COLOR,
        text=plate.label,
    )
