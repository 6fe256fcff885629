"""The coordinate frame of a source, by its newest status in the take, and what files say about it."""

import math
from dataclasses import replace

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import metres_per_unit
from gateway.takes.files.take import TakeSource


def frame_of(source: TakeSource) -> CoordinateFrame:
    """Return the frame of a source with the scale of the settings; that of the server if the take has none.

    A status has no scale: it follows from its metres per unit and the unit of the newest parameters.
    """
    if source.frame is None:
        return CoordinateFrame(source.name, None)
    unit = source.parameters[-1].parameters.length_unit if source.parameters else ""
    metres, of_unit = source.frame.metres_per_unit, metres_per_unit(unit)
    scale = metres / of_unit if metres and of_unit else 1.0
    return replace(source.frame, scale=1.0 if math.isclose(scale, 1.0) else scale)


def is_of_server(frame: CoordinateFrame) -> bool:
    """Whether the server's coordinates are in the frame already."""
    return frame.only_scales and frame.scale == 1.0


def frame_note(source: TakeSource) -> str:
    """Return what the table of changes says about the frame of a file with the server's coordinates.

    "" if nobody has chosen a frame: then it has the name of the source.
    """
    frame = frame_of(source)
    if not is_of_server(frame):
        return (
            f"coordinates of {source.name} are those of the server: "
            f"its transform to the frame {frame.frame_id} is not applied"
        )
    if frame.frame_id != source.name:
        return f"coordinates of {source.name} are in the frame {frame.frame_id}"
    return ""
