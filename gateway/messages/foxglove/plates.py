"""Force plates as Foxglove draws them: their outlines, and an arrow for each force."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
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

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.descriptions.force_plates import (
    METRES_PER_NEWTON,
    PlateForce,
    force_on,
    placed_plates,
)
from gateway.messages.foxglove.topics import timestamp
from gateway.rtc3d.components import Items
from gateway.rtc3d.parameters import Parameters

NO_POSE: Final = Pose(position=Vector3(), orientation=Quaternion(w=1.0))
"""Points without a pose are not valid in rerun."""

_ARROW_COLOR: Final = Color(r=1.0, g=0.75, b=0.1, a=1.0)
_PLATE_COLOR: Final = Color(r=0.6, g=0.6, b=0.65, a=1.0)
_LINE_M: Final = 0.005
_TEXT_M: Final = 0.05
_SHAFT_M: Final = 0.015
_HEAD_M: Final = 0.04

_LIFETIME: Final = Duration(1)
"""An arrow disappears if no other message comes for this many seconds."""


class PlateScene:
    """Draws the plates of one source, as long as its parameters are the same, in ``frame``.

    Plates whose place the parameters do not say are not drawn. Messages are foxglove.SceneUpdate, encoded.
    """

    def __init__(self, parameters: Parameters, frame: CoordinateFrame) -> None:
        self._plates = placed_plates(parameters)
        self._frame_id = frame.frame_id
        self._frame = replace(frame, metres_per_unit=frame.scale)  # plates are in metres already

    def outlines(self, utime: int) -> bytes:
        """Return the outlines and labels of the plates, in place of all earlier ones."""
        time = timestamp(utime)
        entities = []
        for plate in filter(None, self._plates):
            outline = LinePrimitive(
                type=LinePrimitiveLineType.LineLoop,
                pose=NO_POSE,
                thickness=_LINE_M,
                points=[Point3(x=x, y=y, z=z) for x, y, z in self._placed(plate.corners)],
                color=_PLATE_COLOR,
            )
            [[x, y, z]] = self._placed([plate.centre])
            label = TextPrimitive(
                pose=Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(w=1.0)),
                billboard=True,
                font_size=_TEXT_M,
                color=_PLATE_COLOR,
                text=plate.label,
            )
            entities.append(
                SceneEntity(
                    timestamp=time,
                    frame_id=self._frame_id,
                    id=plate.label,
                    lines=[outline],
                    texts=[label],
                )
            )
        deletion = SceneEntityDeletion(timestamp=time, type=SceneEntityDeletionType.All)
        return SceneUpdate(deletions=[deletion], entities=entities).encode()

    def arrows(self, items: Items, utimes: Sequence[int]) -> list[bytes]:
        """Return the message of each frame: an arrow from each centre of pressure.

        ``items`` are those of the Force component, shape (frames, plates).
        """
        forces = [
            [plate and force_on(plate, load) for plate, load in zip(self._plates, loads, strict=False)]
            for loads in items.tolist()
        ]
        arrows = self._arrows([force for row in forces for force in row if force is not None])
        messages = []
        for row, utime in zip(forces, utimes, strict=True):
            time = timestamp(utime)
            entities = [
                # An entity without an arrow removes the one before.
                SceneEntity(
                    timestamp=time,
                    frame_id=self._frame_id,
                    id=plate.label,
                    lifetime=_LIFETIME,
                    arrows=[] if force is None else [next(arrows)],
                )
                for plate, force in zip(self._plates, row, strict=False)
                if plate is not None
            ]
            messages.append(SceneUpdate(entities=entities).encode())
        return messages

    def _arrows(self, forces: Sequence[PlateForce]) -> Iterator[ArrowPrimitive]:
        """Yield the arrow of each force."""
        if not forces:
            return
        positions = self._placed([found.position for found in forces])
        turned = self._frame.vectors(np.array([found.force for found in forces])).tolist()
        for (x, y, z), (fx, fy, fz) in zip(positions, turned, strict=True):
            force = math.hypot(fx, fy, fz)
            length = force * METRES_PER_NEWTON
            head = min(_HEAD_M, length / 2)
            direction = _from_x_axis(fx / force, fy / force, fz / force)
            yield ArrowPrimitive(
                pose=Pose(position=Vector3(x=x, y=y, z=z), orientation=direction),
                shaft_length=length - head,
                shaft_diameter=_SHAFT_M,
                head_length=head,
                head_diameter=_HEAD_M,
                color=_ARROW_COLOR,
            )

    def _placed(self, points: Sequence[Sequence[float]]) -> list[list[float]]:
        moved: list[list[float]] = self._frame.points(np.array(points)).tolist()
        return moved


def _from_x_axis(x: float, y: float, z: float) -> Quaternion:
    """Return the shortest rotation from the x-axis to a direction of length 1."""
    w = 1.0 + x
    if w < 1e-9:
        return Quaternion(x=0.0, y=0.0, z=1.0, w=0.0)
    length = math.sqrt(w * w + y * y + z * z)
    return Quaternion(x=0.0, y=-z / length, z=y / length, w=w / length)
