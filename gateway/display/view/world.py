"""The laboratory in the picture: the floor, the axes and their unit, and where the camera stands."""

import math
from collections.abc import Iterable, Sequence
from typing import Final, Literal, NamedTuple

import numpy as np
import viser

from gateway.descriptions.force_plates import METRES_PER_NEWTON, placed_plates
from gateway.display.view.markers_and_tools import GREY
from gateway.rtc3d.parameters import Parameters
from gateway.takes.files.component_rows import Array

UpAxis = Literal["x", "y", "z"]
UP_AXES: Final[tuple[UpAxis, ...]] = ("z", "y", "x")
PLANES: Final[dict[UpAxis, Literal["xy", "zx", "yz"]]] = {"z": "xy", "y": "zx", "x": "yz"}
"""The floor for each axis that points up; seen from above, the second axis is left of the first one."""

_VERTICAL: Final = 0.95
"""The cosine from which a plate counts as horizontal."""


def on_floor(up: UpAxis, first: float, second: float, height: float = 0.0) -> tuple[float, float, float]:
    """Return a position by its coordinates on the two axes of the floor and above it."""
    by_axis = dict(zip((*PLANES[up], up), (first, second, height), strict=True))
    return by_axis["x"], by_axis["y"], by_axis["z"]


def up_axis_of(parameters: Iterable[Parameters]) -> UpAxis | None:
    """Return the axis that points up, by the plates: people step on them; None if they do not show it."""
    found: set[UpAxis] = set()
    for each in parameters:
        for plate in placed_plates(each):
            if plate is not None:
                by_size = {axis: abs(part) for axis, part in zip("xyz", plate.normal, strict=True)}
                found |= {axis for axis in UP_AXES if by_size[axis] > _VERTICAL}
    return found.pop() if len(found) == 1 else None


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


_AXIS_M: Final = 0.5
_GRID_M: Final = 10.0
_LINE_COLOR: Final = (110, 115, 125)


class World:
    """What does not move. ``up`` is the axis that points up."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        server.scene.configure_default_lights(cast_shadow=False)  # shadows cost browsers more than all else
        self._grids = {axis: self._add_grid(axis) for axis in UP_AXES}
        server.scene.add_frame("/world/axes", axes_length=_AXIS_M, axes_radius=0.006, origin_radius=0.012)
        for axis, place in zip("xyz", ((1, 0, 0), (0, 1, 0), (0, 0, 1)), strict=True):
            position = (_AXIS_M * place[0], _AXIS_M * place[1], _AXIS_M * place[2])
            server.scene.add_label(f"/world/{axis}", axis, position=position, anchor="bottom-center")
        self._unit = server.scene.add_label(
            "/world/unit", "1 m", anchor="center-center", font_screen_scale=0.8
        )
        self.up: UpAxis = "z"
        self.set_up("z")

    def set_up(self, up: UpAxis) -> None:
        """Turn the picture so that this axis points up."""
        self.up = up
        direction = on_floor(up, 0.0, 0.0, 1.0)
        self._server.scene.set_up_direction(direction)
        for axis, grid in self._grids.items():
            grid.visible = axis == up
        self._unit.position = on_floor(up, 1.0, 0.0)

    @property
    def mark(self) -> Array:
        """Where the mark for 1 m is, shape (1, 3)."""
        return np.array([self._unit.position])

    def show_scale(self, *, forces: bool) -> None:
        """Say at the mark for 1 m how much force an arrow of this length is, if there are ``forces``."""
        self._unit.text = f"1 m = {1 / METRES_PER_NEWTON:.0f} N" if forces else "1 m"

    def show_floor(self, *, visible: bool) -> None:
        """Show or hide the floor."""
        self._grids[self.up].visible = visible

    def _add_grid(self, axis: UpAxis) -> viser.GridHandle:
        return self._server.scene.add_grid(
            f"/world/floor {axis}",
            _GRID_M,
            _GRID_M,
            plane=PLANES[axis],
            cell_size=0.25,
            cell_color=GREY,
            cell_thickness=0.4,
            section_size=1.0,
            section_color=_LINE_COLOR,
            section_thickness=1.0,
            fade_distance=15.0,
            shadow_opacity=0.0,
            visible=False,
        )
