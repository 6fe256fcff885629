"""Force plates on ROS 2: the coordinate frame of each, and where the force on it acts."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gateway.messages.coordinate_frame import NO_ROTATION, CoordinateFrame
from gateway.messages.descriptions.force_plates import PlacedPlate, force_on, placed_plates
from gateway.messages.ros2.encode import TransformNames, pack_pose
from gateway.messages.ros2.names import plate_name
from gateway.rtc3d.parameters import Parameters

Transform = tuple[TransformNames, bytes]
"""As ``tf_message`` takes it."""


class PlateFrame:
    """The frame of a plate whose place is known, such as lab/force_1, in the frame of its source.

    Its origin is the centre of the plate's surface, about which the server's moments are (§7.5). Its axes are
    those of the source's frame, as the published forces and moments have them.
    """

    def __init__(self, plate: PlacedPlate, frame: CoordinateFrame, frame_id: str) -> None:
        self.frame_id = frame_id
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
        [[x, y, z]] = self._frame.points(np.array([force.position])).tolist()
        return x, y, z


def plate_frames(parameters: Parameters, frame: CoordinateFrame, source: str) -> list[PlateFrame | None]:
    """Return the frames of a source's plates, in their order; None for one without a known place."""
    return [
        None if plate is None else PlateFrame(plate, frame, f"{source}/{plate_name(number)}")
        for number, plate in enumerate(placed_plates(parameters), start=1)
    ]
