"""What stands in the picture of a source: markers with trails, labels, colours and axes."""

from collections import deque
from collections.abc import Sequence
from typing import Any, Final, Literal

import numpy as np
import viser

from gateway.messages.descriptions.force_plates import UpAxis
from gateway.messages.encode import metres_per_unit
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

MAX_CHARACTERS: Final = 100
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
        return safe_text(self._prefix + self._texts[index], MAX_CHARACTERS)


NO_LINES: Final = np.empty((0, 2, 3), np.float32)

LENGTH_S: Final = 0.5
MAX_SEGMENTS: Final = 5000
"""How many segments all trails of a source have together; with many markers, trails are shorter."""


class Trails:
    """The trails of the markers of a source, drawn 15 times a second."""

    def __init__(self, scene: viser.SceneApi, name: str, color: Rgb) -> None:
        self._node = scene.add_line_segments(name, NO_LINES, color, thickness=1.5, thickness_units="screen")
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
            self._node.points = NO_LINES


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


UP_AXES: Final[tuple[UpAxis, ...]] = ("z", "y", "x")
PLANES: Final[dict[UpAxis, Literal["xy", "zx", "yz"]]] = {"z": "xy", "y": "zx", "x": "yz"}
"""The floor for each axis that points up; seen from above, the second axis is left of the first one."""


def on_floor(up: UpAxis, first: float, second: float, height: float = 0.0) -> tuple[float, float, float]:
    """Return a position by its coordinates on the two axes of the floor and above it."""
    by_axis = dict(zip((*PLANES[up], up), (first, second, height), strict=True))
    return by_axis["x"], by_axis["y"], by_axis["z"]
