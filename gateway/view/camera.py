"""Where the camera of a browser stands, so that it sees all data."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import viser

from gateway.takes.component_rows import Array
from gateway.view.axes import UpAxis, on_floor

_MIN_RADIUS_M: Final = 0.3
_MARGIN: Final = 1.15
_FROM: Final = (0.6, -1.0, 0.5)
"""The direction from what is seen to the camera: on the two axes of the floor, and up."""

_FAR: Final = 4.0
"""Points that are this much farther from the middle than most others are not what the picture is about."""


class Sphere(NamedTuple):
    """What is to be seen, in metres."""

    centre: tuple[float, float, float]
    radius: float


def sphere_around(parts: Sequence[Array]) -> Sphere | None:
    """Return a sphere around points, each part of shape (points, 3); None without any. NaN is left out."""
    points = np.concatenate([np.empty((0, 3)), *parts])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    near = points[distances <= _FAR * np.percentile(distances, 75) + _MIN_RADIUS_M]
    centre = (near.min(axis=0) + near.max(axis=0)) / 2
    radius = max(_MIN_RADIUS_M, float(np.linalg.norm(near - centre, axis=1).max()))
    x, y, z = centre.tolist()
    return Sphere((x, y, z), radius)


def fit(client: viser.ClientHandle, sphere: Sphere, up: UpAxis) -> None:
    """Turn the camera of one browser so that it sees the sphere.

    Raises ValueError if the browser has said that its camera is at no place.
    """
    camera = client.camera
    aspect = camera.image_width / max(1, camera.image_height)  # the height of a page can be 0
    angle = min(camera.fov, 2 * math.atan(math.tan(camera.fov / 2) * max(0.1, aspect)))
    distance = _MARGIN * sphere.radius / math.sin(min(max(0.1, angle), math.pi) / 2)
    direction = np.array(on_floor(up, *_FROM))
    position = np.array(sphere.centre) + distance * direction / np.linalg.norm(direction)
    with client.atomic():
        camera.up_direction = on_floor(up, 0.0, 0.0, 1.0)
        camera.position = position
        camera.look_at = sphere.centre
