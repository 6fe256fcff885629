"""The force plates of a source."""

from typing import Any, Final

import numpy as np
import viser

from gateway.descriptions.force_plates import (
    METRES_PER_NEWTON,
    PlacedPlate,
    force_on,
    placed_plates,
    units_of,
)
from gateway.display.live.component import LiveComponent
from gateway.display.view.markers_and_tools import MAX_M, Labels
from gateway.display.view.world import UpAxis, on_floor
from gateway.rtc3d.parameters import Parameters
from gateway.takes.files.component_rows import Array

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
