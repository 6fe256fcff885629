"""Force plates in Foxglove's 3D scene: their outlines, and an arrow for each force."""

import math
from collections.abc import Sequence
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

from gateway.descriptions.force_plates import METRES_PER_NEWTON, PlacedPlate, force_on, placed_plates
from gateway.foxglove_schemas.topics import FoxgloveMessage, timestamp, topic_of
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.rtc3d.components import Items
from gateway.rtc3d.parameters import Parameters

_ARROW_COLOR: Final = Color(r=1.0, g=0.75, b=0.1, a=1.0)
_PLATE_COLOR: Final = Color(r=0.6, g=0.6, b=0.65, a=1.0)
_LINE_M: Final = 0.005
_TEXT_M: Final = 0.05
_SHAFT_M: Final = 0.015
_HEAD_M: Final = 0.04

_LIFETIME: Final = Duration(1)
"""An arrow disappears if no other message comes for this many seconds."""


class ForceScene:
    """The plates of one source and the forces on them. Plates without a known place are not drawn."""

    def __init__(self, source: str, parameters: Parameters, frame: CoordinateFrame) -> None:
        self.outlines_topic = topic_of(f"/{source}/plates", SceneUpdate)
        self.arrows_topic = topic_of(f"/{source}/forces", SceneUpdate)
        self._plates = placed_plates(parameters)
        self._frame = replace(frame, metres_per_unit=frame.scale)  # plates are in metres already

    def plates(self, utime: int) -> FoxgloveMessage:
        """Return the outlines and labels of the plates, in place of all earlier ones."""
        time = timestamp(utime)
        update = SceneUpdate(
            deletions=[SceneEntityDeletion(timestamp=time, type=SceneEntityDeletionType.All)],
            entities=[
                SceneEntity(
                    timestamp=time,
                    frame_id=self._frame.frame_id,
                    id=plate.label,
                    lines=[_outline(plate, self._frame)],
                    texts=[_text(plate, self._frame)],
                )
                for plate in self._plates
                if plate is not None
            ],
        )
        return FoxgloveMessage(self.outlines_topic, utime, update.encode())

    def arrows(self, items: Items, utime: int) -> FoxgloveMessage:
        """Return an arrow from each centre of pressure; ``items`` are those of the Force component."""
        time = timestamp(utime)
        entities = [
            # An entity without an arrow removes the one before.
            SceneEntity(
                timestamp=time,
                frame_id=self._frame.frame_id,
                id=plate.label,
                lifetime=_LIFETIME,
                arrows=_arrow(plate, load, self._frame),
            )
            for plate, load in zip(self._plates, items.tolist(), strict=False)
            if plate is not None
        ]
        return FoxgloveMessage(self.arrows_topic, utime, SceneUpdate(entities=entities).encode())


def _placed(points: Sequence[Sequence[float]], frame: CoordinateFrame) -> list[list[float]]:
    moved: list[list[float]] = frame.points(np.array(points)).tolist()
    return moved


def _arrow(plate: PlacedPlate, load: tuple[float, ...], frame: CoordinateFrame) -> list[ArrowPrimitive]:
    """Return the arrow of a load; [] if it is too small or not known."""
    found = force_on(plate, load)
    if found is None:
        return []
    [[x, y, z]] = _placed([found.position], frame)
    [[fx, fy, fz]] = frame.vectors(np.array([found.force])).tolist()
    force = math.hypot(fx, fy, fz)
    length = force * METRES_PER_NEWTON
    head = min(_HEAD_M, length / 2)
    return [
        ArrowPrimitive(
            pose=Pose(
                position=Vector3(x=x, y=y, z=z),
                orientation=_from_x_axis(fx / force, fy / force, fz / force),
            ),
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


def _outline(plate: PlacedPlate, frame: CoordinateFrame) -> LinePrimitive:
    return LinePrimitive(
        type=LinePrimitiveLineType.LineLoop,
        pose=Pose(position=Vector3(), orientation=Quaternion(w=1.0)),
        thickness=_LINE_M,
        points=[Point3(x=x, y=y, z=z) for x, y, z in _placed(plate.corners, frame)],
        color=_PLATE_COLOR,
    )


def _text(plate: PlacedPlate, frame: CoordinateFrame) -> TextPrimitive:
    [[x, y, z]] = _placed([plate.centre], frame)
    return TextPrimitive(
        pose=Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(w=1.0)),
        billboard=True,
        font_size=_TEXT_M,
        color=_PLATE_COLOR,
        text=plate.label,
    )
