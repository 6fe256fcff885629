"""Force plates on ROS 2: units, the coordinate frame of each plate, and where the force on it acts."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gateway.messages.coordinate_frame import NO_ROTATION, CoordinateFrame
from gateway.messages.descriptions.force_plates import (
    PlacedPlate,
    force_on,
    ground_reactions,
    placed_plates,
    units_of,
)
from gateway.messages.ros2.encode import StampedEncoder, TransformNames, pack_pose
from gateway.messages.ros2.names import plate_name
from gateway.rtc3d.parameters import Parameters

Array: TypeAlias = npt.NDArray[Any]

Transform = tuple[TransformNames, bytes]
"""As ``tf_message`` takes it."""


class PlateFrame:
    """The frame of a plate whose place is known, such as lab/force_1, in the frame of its source.

    Its origin is the centre of the plate's surface, about which the server's moments are (§7.5). Its axes are
    those of the source's frame, as the published forces and moments have them.
    """

    def __init__(self, plate: PlacedPlate, frame: CoordinateFrame, frame_id: str) -> None:
        self.stamped = StampedEncoder(frame_id)
        """Encodes what is in this frame."""
        self._plate = plate
        self._frame = replace(frame, metres_per_unit=frame.scale)  # plates are in metres already
        [origin] = self._frame.points(np.array([plate.centre])).tolist()
        self.transform: Transform = (
            TransformNames(frame.frame_id, frame_id),
            pack_pose(*origin, *NO_ROTATION),
        )

    def centre_of_pressure(self, load: Sequence[float]) -> tuple[float, float, float] | None:
        """Return where the force of a load acts, in m in the frame of the source; None without contact.

        ``load`` has the server's units and axes.
        """
        force = force_on(self._plate, tuple(load))
        if force is None:
            return None
        x, y, z = force.position
        if self._frame.only_scales:  # as usual, in a tenth of the time
            scale = self._frame.scale
            return x * scale, y * scale, z * scale
        [[x, y, z]] = self._frame.points(np.array([force.position])).tolist()
        return x, y, z

    def centres_of_pressure(self, loads: Array) -> tuple[Array, Array]:
        """Return in which rows of ``loads``, shape (rows, 6), there is contact, and the centres of these."""
        plate = self._plate
        units = np.array([plate.newtons] * 3 + [plate.newton_metres] * 3)
        reactions = ground_reactions(loads * units, np.array(plate.normal), np.array(plate.centre))
        has_contact = np.asarray(reactions.forces.any(axis=1))
        return has_contact, self._frame.points(reactions.positions[has_contact])


class RosPlate(NamedTuple):
    """The units of a plate's forces and moments, in N and Nm, and its frame, if its place is known."""

    newtons: float
    newton_metres: float
    frame: PlateFrame | None


def ros_plates(
    parameters: Parameters, frame: CoordinateFrame, source: str, num_plates: int
) -> list[RosPlate]:
    """Return the plates of a source, ``num_plates`` at least: those that are not described have N and Nm."""
    described = parameters.force.plates if parameters.force else ()
    plates = []
    for number, (plate, placed) in enumerate(zip(described, placed_plates(parameters), strict=True), start=1):
        frame_id = f"{source}/{plate_name(number)}"
        plates.append(
            RosPlate(*units_of(plate), None if placed is None else PlateFrame(placed, frame, frame_id))
        )
    return plates + [RosPlate(1.0, 1.0, None)] * (num_plates - len(plates))


def transforms_of(plates: Sequence[RosPlate]) -> list[Transform]:
    """Return where the plates are whose place is known."""
    return [plate.frame.transform for plate in plates if plate.frame is not None]
