"""What stands in the picture of a source: markers with trails, tools, force plates, and their labels."""

from collections import deque
from collections.abc import Sequence
from typing import Any, Final, Literal

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
from gateway.messages.encode import metres_per_unit
from gateway.rtc3d.parameters import Parameters
from gateway.runtime.safe_text import safe_text
from gateway.takes.files.component_rows import Array
from gateway.tools.display.live import LiveComponent

MAX_M: Final = 1000.0
"""Positions farther from the origin are not shown: no laboratory is that large."""


def positions_in_metres(items: Array, unit: str) -> Array:
    """Return the positions of markers or tools in metres, shape (items, 3), as float32.

    All three coordinates are NaN if one of them is missing or beyond MAX_M. An unknown unit counts as mm.
    """
    positions = np.stack([items["x"], items["y"], items["z"]], axis=-1).astype(np.float64)
    positions *= metres_per_unit(unit) or 1e-3
    positions[~(abs(positions) <= MAX_M).all(axis=1)] = np.nan
    return positions.astype(np.float32)


def is_shown(positions: Array) -> Array:
    """Return for each position whether it is shown, shape (items,): NaN is not."""
    shown: Array = ~np.isnan(positions[:, 0])
    return shown


Rgb = tuple[int, int, int]

GREY: Final[Rgb] = (128, 128, 128)
"""What is not live."""

COLORS: Final[Sequence[Rgb]] = (
    *((34, 139, 230), (240, 125, 20), (55, 165, 70)),
    *((150, 90, 220), (225, 60, 60), (150, 100, 60)),
)


def color_of(number: int) -> Rgb:
    """Return the colour of the source with this number."""
    return COLORS[number % len(COLORS)]


MAX_LABELS: Final = 300
"""How many items of one kind have labels."""

_MAX_CHARACTERS: Final = 100
"""How much of a label is drawn. Labels come from the network."""

_PERIOD_S: Final = 1 / 15
"""How often labels and trails are moved."""

_PER_PERIOD: Final = 40
"""How many labels are moved at a time, because each one costs as much as all markers."""
_MOVED_M: Final = 0.002


class Labels:
    """The labels of the first MAX_LABELS items. ``path`` is the node above them."""

    def __init__(self, scene: viser.SceneApi, path: str) -> None:
        self._scene = scene
        self._parent = scene.add_frame(path, show_axes=False)
        self._nodes: list[viser.LabelHandle] = []
        self._positions = np.empty((0, 3), np.float32)  # as they are shown; NaN is hidden
        self._texts: Sequence[str] = ()
        self._prefix = ""
        self._next = 0
        self._moved_s = 0.0

    def update(
        self, positions: Array, texts: Sequence[str], now_s: float, prefix: str = "", *, shown: bool = True
    ) -> None:
        """Show the labels at ``positions``, shape (items, 3), not all at a time; NaN hides one.

        ``prefix`` precedes each text. None is visible unless they are ``shown``.
        """
        if not shown:
            self._parent.visible = False
            return
        if now_s - self._moved_s < _PERIOD_S:
            return
        self._moved_s = now_s
        self._parent.visible = True
        count = min(MAX_LABELS, len(positions), len(texts))
        first = len(self._nodes)
        for index in range(first, min(count, first + _PER_PERIOD)):
            text = self._text(index) if index < len(self._texts) else ""
            name = f"{self._parent.name}/{index}"
            self._nodes.append(
                self._scene.add_label(name, text, visible=False, font_screen_scale=0.8, anchor="bottom-left")
            )
        added = np.full((len(self._nodes) - first, 3), np.nan, np.float32)
        self._positions = np.concatenate([self._positions, added])
        if texts is not self._texts or prefix != self._prefix:
            self._texts, self._prefix = texts, prefix
            for index, node in enumerate(self._nodes[: len(texts)]):
                node.text = self._text(index)
        wanted = np.full_like(self._positions, np.nan)
        wanted[:count] = positions[: len(wanted)][:count]
        differs = is_shown(wanted) != is_shown(self._positions)
        differs |= (abs(wanted - self._positions) > _MOVED_M).any(axis=1)
        indices = np.flatnonzero(differs).tolist()
        start = int(np.searchsorted(indices, self._next))
        for index in [*indices[start:], *indices[:start]][:_PER_PERIOD]:
            node, position = self._nodes[index], wanted[index]
            if visible := bool(np.isfinite(position[0])):
                node.position = position
            node.visible = visible
            self._positions[index] = position
            self._next = index + 1

    def _text(self, index: int) -> str:
        return safe_text(self._prefix + self._texts[index], _MAX_CHARACTERS)


_NO_LINES: Final = np.empty((0, 2, 3), np.float32)

LENGTH_S: Final = 1.0
MAX_SEGMENTS: Final = 5000
"""How many segments all trails of a source have together; with many markers, trails are shorter."""


class Trails:
    """The trails of the markers of a source, drawn 15 times a second."""

    def __init__(self, scene: viser.SceneApi, name: str, color: Rgb) -> None:
        self._node = scene.add_line_segments(name, _NO_LINES, color, thickness=1.5, thickness_units="screen")
        self._history: deque[tuple[float, Array]] = deque()

    def update(self, positions: Array, now_s: float) -> None:
        """Take the positions of a frame, shape (markers, 3); NaN interrupts a trail."""
        if self._history and now_s - self._history[-1][0] < _PERIOD_S:
            return
        if self._history and len(self._history[-1][1]) != len(positions):
            self._history.clear()
        self._history.append((now_s, positions))
        max_steps = MAX_SEGMENTS // max(1, len(positions))
        while len(self._history) > max_steps + 1 or now_s - self._history[0][0] > LENGTH_S:
            self._history.popleft()
        table = np.stack([each for _, each in self._history])
        segments = np.stack([table[:-1], table[1:]], axis=2).reshape(-1, 2, 3)
        self._node.points = segments[~np.isnan(segments).any(axis=(1, 2))]

    def clear(self) -> None:
        """Remove the trails."""
        if self._history:
            self._history.clear()
            self._node.points = _NO_LINES


GHOST_S: Final = 1.0
"""How long the last place of a missing marker is shown."""

_SIZE_M: Final = 0.025
_GHOST_SIZE_M: Final = 0.015
_NOTHING: Final = np.empty((0, 3), np.float32)


class Markers:
    """The visible markers as points, and the last places of missing ones. ``path`` is the node above them."""

    def __init__(self, scene: viser.SceneApi, path: str, color: Rgb) -> None:
        def points(name: str, color: Rgb, size_m: float) -> viser.PointCloudHandle:
            return scene.add_point_cloud(
                f"{path}/{name}",
                _NOTHING,
                color,
                point_size=size_m,
                point_shape="circle",
                precision="float32",
            )

        red, green, blue = ((value + 3 * grey) // 4 for value, grey in zip(color, GREY, strict=True))
        faint = (red, green, blue)
        self._color = color
        self._points = points("markers", color, _SIZE_M)
        self._ghosts = points("missing markers", faint, _GHOST_SIZE_M)
        self._labels = Labels(scene, f"{path}/marker labels")
        self._trails = Trails(scene, f"{path}/trails", faint)
        self._head: Any = None
        self._names: tuple[str, ...] = ()
        self._seen = _NOTHING
        self._seen_s = np.empty(0)
        self._is_missing = self._is_ghost = np.empty(0, bool)
        self._is_stopped = False
        self.positions: Array = _NOTHING
        """The positions in the newest frame, shape (markers, 3), in metres; NaN is missing."""

    def update(
        self, component: LiveComponent, now_s: float, prefix: str, *, labels: bool, trails: bool
    ) -> None:
        """Show the newest frame. ``prefix`` precedes each label."""
        if component.newest_head is not self._head:
            self._head = component.newest_head
            self._take(component, now_s)
        if component.is_stopped != self._is_stopped:
            self._is_stopped = component.is_stopped
            self._points.colors = np.array(GREY if self._is_stopped else self._color, np.uint8)
        is_ghost = self._is_missing & (now_s - self._seen_s < GHOST_S) & (not self._is_stopped)
        if not np.array_equal(is_ghost, self._is_ghost):
            self._is_ghost = is_ghost
            self._ghosts.points = self._seen[is_ghost]
        self._labels.update(self.positions, self._names, now_s, prefix, shown=labels)
        if trails and not self._is_stopped:
            self._trails.update(self.positions, now_s)
        else:
            self._trails.clear()

    def _take(self, component: LiveComponent, now_s: float) -> None:
        names, unit = component.description.labels, component.description.unit
        self.positions = positions_in_metres(component.newest_items, unit)
        visible = is_shown(self.positions)
        if names is not self._names and names != self._names:  # positions belong to other markers now
            self._seen = np.full((len(visible), 3), np.nan, np.float32)
            self._seen_s = np.full(len(visible), -np.inf)
            self._trails.clear()
        self._names = names
        self._is_missing = ~visible
        self._seen[visible] = self.positions[visible]
        self._seen_s[visible] = now_s
        self._points.points = self.positions[visible]


_AXES_M: Final = 0.15
_RADIUS_M: Final = 0.005
_STOPPED_SIZE: Final = 0.3
_MIN_NORM: Final = 1e-3
"""A quaternion that is shorter says nothing about the orientation."""


class Tools:
    """The visible tools as axes with labels. ``path`` is the node above them."""

    def __init__(self, scene: viser.SceneApi, path: str) -> None:
        self._scene = scene
        self._name = f"{path}/tools"
        self._axes: viser.BatchedAxesHandle | None = None
        self._labels = Labels(scene, f"{path}/tool labels")
        self._head: Any = None
        self._names: tuple[str, ...] = ()
        self._sizes = np.empty(0, np.float32)
        self.positions: Array = _NOTHING
        """The positions in the newest frame, shape (tools, 3), in metres; NaN is missing."""

    def update(self, component: LiveComponent, now_s: float, prefix: str, *, labels: bool) -> None:
        """Show the newest frame. ``prefix`` precedes each label."""
        if component.newest_head is not self._head:
            self._head = component.newest_head
            self._take(component)
        size = _STOPPED_SIZE if component.is_stopped else 1.0
        sizes = is_shown(self.positions) * np.float32(size)  # that of missing tools is 0
        if self._axes is not None and not np.array_equal(sizes, self._sizes):
            self._axes.batched_scales = self._sizes = sizes
        self._labels.update(self.positions, self._names, now_s, prefix, shown=labels)

    def _take(self, component: LiveComponent) -> None:
        items = component.newest_items
        self._names = component.description.labels
        positions = positions_in_metres(items, component.description.unit)
        quaternions = np.stack([items[name] for name in ("q0", "qx", "qy", "qz")], axis=-1)
        norms = np.linalg.norm(quaternions.astype(np.float64), axis=1)
        is_valid = np.isfinite(norms) & (norms > _MIN_NORM)
        positions[~is_valid] = np.nan
        self.positions = positions
        visible = is_shown(positions)
        turned = np.zeros((len(items), 4), np.float32)
        turned[:, 0] = 1.0
        turned[visible] = quaternions[visible] / norms[visible, None]
        places = np.nan_to_num(positions)
        if self._axes is not None and len(self._axes.batched_positions) == len(items):
            self._axes.batched_wxyzs = turned
            self._axes.batched_positions = places
            return
        self._sizes = np.zeros(len(items), np.float32)
        self._axes = self._scene.add_batched_axes(
            self._name,
            turned,
            places,
            self._sizes,
            axes_length=_AXES_M,
            axes_radius=_RADIUS_M,
            visible=len(items) > 0,
        )


UP_AXES: Final[tuple[UpAxis, ...]] = ("z", "y", "x")
PLANES: Final[dict[UpAxis, Literal["xy", "zx", "yz"]]] = {"z": "xy", "y": "zx", "x": "yz"}
"""The floor for each axis that points up; seen from above, the second axis is left of the first one."""


def on_floor(up: UpAxis, first: float, second: float, height: float = 0.0) -> tuple[float, float, float]:
    """Return a position by its coordinates on the two axes of the floor and above it."""
    by_axis = dict(zip((*PLANES[up], up), (first, second, height), strict=True))
    return by_axis["x"], by_axis["y"], by_axis["z"]


MAX_PLATES: Final = 100
MAX_ARROW_M: Final = 5.0

_OUTLINE_COLOR: Final = (140, 145, 155)
_ARROW_COLOR: Final = (235, 165, 20)
_WIDTH_M: Final = 0.6
_DEPTH_M: Final = 0.4
_GAP_M: Final = 0.1
_HEAD_M: Final = 0.06
_MIN_ARROW_M: Final = 2 * _HEAD_M


class Plates:
    """The outlines and names of plates, and arrows of the forces on them. ``path`` is the node above them.

    When data stop, the last arrows remain, in grey. Plates whose place is not known stand side by side at the
    origin. Several sources may have the same
    plates, so the labels of the first source, ``number`` 0, are at the centres, others towards corners.
    """

    def __init__(self, scene: viser.SceneApi, path: str, number: int) -> None:
        self._number = number
        self._outlines = scene.add_line_segments(
            f"{path}/plates", _NO_LINES, _OUTLINE_COLOR, thickness=2.5, thickness_units="screen"
        )
        self._arrows = scene.add_arrows(
            f"{path}/forces",
            _NO_LINES,
            _ARROW_COLOR,
            shaft_radius=0.012,
            head_radius=0.03,
            head_length=_HEAD_M,
        )
        self._labels = Labels(scene, f"{path}/plate labels")
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
            arrows = []
            for plate, load in zip(self._plates, component.newest_items[:MAX_PLATES].tolist(), strict=False):
                found = force_on(plate, load)
                if found is None:
                    continue
                start = np.array(found.position)
                arrow = np.array(found.force) * METRES_PER_NEWTON
                length = float(np.linalg.norm(arrow))
                if np.all(abs(start) <= MAX_M) and length > _MIN_ARROW_M:
                    arrows.append((start, start + arrow * min(1.0, MAX_ARROW_M / length)))
            self._arrows.points = np.array(arrows, np.float32).reshape(-1, 2, 3)

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
