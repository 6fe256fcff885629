"""The force plates in the picture of a source, and the forces on them."""

from typing import Any, Final

import numpy as np
import viser

from gateway.messages.descriptions.force_plates import (
    METRES_PER_NEWTON,
    PlacedPlate,
    UpAxis,
    force_on,
    placed_plates,
    units_of,
)
from gateway.rtc3d.parameters import Parameters
from gateway.takes.files.component_rows import Array
from gateway.tools.display.live import LiveComponent
from gateway.tools.display.view.scene_items import GREY, MAX_M, NO_LINES, Labels, on_floor

MAX_PLATES: Final = 100
MAX_ARROW_M: Final = 5.0

_OUTLINE_COLOR: Final = (140, 145, 155)
_ARROW_COLOR: Final = (235, 165, 20)
_WIDTH_M: Final = 0.6
_DEPTH_M: Final = 0.4
_GAP_M: Final = 0.1
_HEAD_M: Final = 0.06
_MIN_ARROW_M: Final = 2 * _HEAD_M


_VALUE_PERIOD_S: Final = 0.25
"""How often the values of forces change, so that they can be read."""


class ForceValues:
    """The values of forces in N, as labels at the tips of their arrows. ``path`` is the node above them."""

    def __init__(self, scene: viser.SceneApi, path: str) -> None:
        self._scene = scene
        self._path = path
        self._nodes: list[viser.LabelHandle] = []
        self._changed_s = 0.0

    def update(self, tips: Array, forces_n: list[float], now_s: float) -> None:
        """Show the forces at ``tips``, shape (forces, 3), in m."""
        is_due = now_s - self._changed_s >= _VALUE_PERIOD_S
        self._changed_s = now_s if is_due else self._changed_s
        for number, (tip, force_n) in enumerate(zip(tips, forces_n, strict=True)):
            text = f"{force_n:.0f} N"
            if number == len(self._nodes):
                name = f"{self._path}/{number}"
                self._nodes.append(self._scene.add_label(name, text, font_screen_scale=0.95))
            node = self._nodes[number]
            if is_due or not node.visible:
                node.text = text
            node.position, node.visible = tip, True
        for node in self._nodes[len(forces_n) :]:
            node.visible = False


class Plates:
    """The outlines and names of plates, and arrows of the forces on them. ``path`` is the node above them.

    When data stop, the last arrows remain, in grey. Plates whose place is not known stand side by side at the
    origin. Several sources may have the same
    plates, so the labels of the first source, ``number`` 0, are at the centres, others towards corners.
    """

    def __init__(self, scene: viser.SceneApi, path: str, number: int) -> None:
        self._number = number
        self._outlines = scene.add_line_segments(
            f"{path}/plates", NO_LINES, _OUTLINE_COLOR, thickness=2.5, thickness_units="screen"
        )
        self._arrows = scene.add_arrows(
            f"{path}/forces",
            NO_LINES,
            _ARROW_COLOR,
            shaft_radius=0.012,
            head_radius=0.03,
            head_length=_HEAD_M,
        )
        self._labels = Labels(scene, f"{path}/plate labels")
        self._values = ForceValues(scene, f"{path}/force values")
        self._known: tuple[Parameters | None, int, UpAxis] = (None, 0, "z")
        self._plates: list[PlacedPlate] = []
        self._names: tuple[str, ...] = ()
        self._label_places: Array = np.empty((0, 3), np.float32)
        self._head: Any = None
        self._is_stopped = False
        self.corners: Array = np.empty((0, 3), np.float32)
        """The corners of all plates, shape (corners, 3), in metres."""

    def update(
        self, component: LiveComponent | None, parameters: Parameters, up: UpAxis, now_s: float, prefix: str
    ) -> None:
        """Show the plates, and the forces of the newest frame. ``prefix`` precedes each label."""
        num_items = 0 if component is None else len(component.newest_items)
        if self._known[0] is not parameters or self._known[1:] != (num_items, up):
            self._known = (parameters, num_items, up)
            self._place(parameters, component, up)
        self._labels.update(self._label_places, self._names, now_s, prefix)
        is_stopped = component is not None and component.is_stopped
        if is_stopped != self._is_stopped:
            self._is_stopped = is_stopped
            self._arrows.colors = np.array(GREY if is_stopped else _ARROW_COLOR, np.uint8)
            self._outlines.colors = np.array(GREY if is_stopped else _OUTLINE_COLOR, np.uint8)
        if component is not None and component.newest_head is not self._head:
            self._head = component.newest_head
            arrows, forces_n = [], []
            for plate, load in zip(self._plates, component.newest_items[:MAX_PLATES].tolist(), strict=False):
                found = force_on(plate, load)
                if found is None:
                    continue
                start = np.array(found.position)
                arrow = np.array(found.force) * METRES_PER_NEWTON
                length = float(np.linalg.norm(arrow))
                if np.all(abs(start) <= MAX_M) and length > _MIN_ARROW_M:
                    arrows.append((start, start + arrow * min(1.0, MAX_ARROW_M / length)))
                    forces_n.append(length / METRES_PER_NEWTON)
            self._arrows.points = points = np.array(arrows, np.float32).reshape(-1, 2, 3)
            self._values.update(points[:, 1], forces_n, now_s)

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
