"""The laboratory in the picture: the floor, its axes and their unit, the camera, and the force plates."""

import math
from collections.abc import Iterable, Sequence
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import viser

from gateway.descriptions.force_plates import (
    METRES_PER_NEWTON,
    PlacedPlate,
    force_on,
    placed_plates,
    units_of,
)
from gateway.display.live import LiveComponent
from gateway.display.view.markers_and_tools import GREY, MAX_M, Labels
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


MAX_PLATES: Final = 100
MAX_ARROW_M: Final = 5.0

_OUTLINE_COLOR: Final = (140, 145, 155)
_ARROW_COLOR: Final = (235, 165, 20)
_WIDTH_M: Final = 0.6
_DEPTH_M: Final = 0.4
_GAP_M: Final = 0.1
_HEAD_M: Final = 0.06
_MIN_ARROW_M: Final = 2 * _HEAD_M
_NOTHING: Final = np.empty((0, 2, 3), np.float32)


class Plates:
    """The outlines and names of plates, and arrows of the forces on them. ``path`` is the node above them.

    Plates whose place is not known stand side by side at the origin. Several sources may have the same
    plates, so the labels of the first source, ``number`` 0, are at the centres, others towards corners.
    """

    def __init__(self, scene: viser.SceneApi, path: str, number: int) -> None:
        self._number = number
        self._outlines = scene.add_line_segments(
            f"{path}/plates", _NOTHING, _OUTLINE_COLOR, thickness=2.5, thickness_units="screen"
        )
        self._arrows = scene.add_arrows(
            f"{path}/forces",
            _NOTHING,
            _ARROW_COLOR,
            shaft_radius=0.012,
            head_radius=0.03,
            head_length=_HEAD_M,
        )
        self._labels = Labels(scene, f"{path}/plate labels")
        self._known: tuple[Parameters, int, UpAxis] | None = None
        self._plates: list[PlacedPlate] = []
        self._names: tuple[str, ...] = ()
        self._label_places: Array = np.empty((0, 3), np.float32)
        self._head: Any = None
        self.corners: Array = np.empty((0, 3), np.float32)
        """The corners of all plates, shape (corners, 3), in metres."""

    def update(
        self, component: LiveComponent | None, parameters: Parameters, up: UpAxis, now_s: float, prefix: str
    ) -> None:
        """Show the plates, and the forces of the newest frame. ``prefix`` precedes each label."""
        num_items = 0 if component is None else len(component.newest_items)
        known = self._known
        if known is None or known[0] is not parameters or known[1:] != (num_items, up):
            self._known = (parameters, num_items, up)
            self._place(parameters, component, up)
        self._labels.update(self._label_places, self._names, now_s, prefix)
        if component is None or component.is_stopped:
            self._head = None
            self._arrows.points = _NOTHING
        elif component.newest_head is not self._head:
            self._head = component.newest_head
            self._arrows.points = self._arrows_of(component.newest_items[:MAX_PLATES].tolist())

    def _place(self, parameters: Parameters, component: LiveComponent | None, up: UpAxis) -> None:
        found = placed_plates(parameters)
        names = () if component is None else component.description.labels
        count = min(MAX_PLATES, max(len(found), len(names)))
        found = [*found, *[None] * (count - len(found))][:count]
        num_unknown = 0
        self._plates = []
        for number, plate in enumerate(found):
            if plate is None or not np.all(abs(np.array(plate.corners)) <= MAX_M):
                label = names[number] if number < len(names) else f"plate {number + 1}"
                self._plates.append(_nominal_plate(label, num_unknown, parameters, number, up))
                num_unknown += 1
            else:
                self._plates.append(plate)
        self._names = tuple(plate.label for plate in self._plates)
        centres = np.array([plate.centre for plate in self._plates], np.float32).reshape(-1, 3)
        corners = np.array([plate.corners for plate in self._plates], np.float32).reshape(-1, 4, 3)
        towards = corners[:, self._number % 4] if self._number else centres
        self._label_places = (centres + towards) / 2
        self.corners = corners.reshape(-1, 3)
        self._outlines.points = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 3)

    def _arrows_of(self, loads: list[tuple[float, ...]]) -> Array:
        arrows = []
        for plate, load in zip(self._plates, loads, strict=False):
            found = force_on(plate, load)
            if found is None:
                continue
            start = np.array(found.position)
            arrow = np.array(found.force) * METRES_PER_NEWTON
            length = float(np.linalg.norm(arrow))
            if np.all(abs(start) <= MAX_M) and length > _MIN_ARROW_M:
                arrows.append((start, start + arrow * min(1.0, MAX_ARROW_M / length)))
        return np.array(arrows, np.float32).reshape(-1, 2, 3)


def _nominal_plate(label: str, place: int, parameters: Parameters, number: int, up: UpAxis) -> PlacedPlate:
    """Return a plate whose place is not known, at a place of its own on the floor."""
    plates = parameters.force.plates if parameters.force else ()
    units = units_of(plates[number]) if number < len(plates) else (1.0, 1.0)
    x = place * (_WIDTH_M + _GAP_M)
    corners = [
        on_floor(up, x + sx * _WIDTH_M / 2, sy * _DEPTH_M / 2)
        for sx, sy in ((1, 1), (-1, 1), (-1, -1), (1, -1))
    ]
    return PlacedPlate(
        f"{label} (place unknown)",
        [list(corner) for corner in corners],
        on_floor(up, x, 0.0),
        on_floor(up, 0.0, 0.0, 1.0),
        *units,
    )
