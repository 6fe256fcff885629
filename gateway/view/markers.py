"""The markers of a source."""

from typing import Any, Final

import numpy as np
import viser

from gateway.live.component import LiveComponent
from gateway.takes.component_rows import Array
from gateway.view.colors import GREY, SourceColor
from gateway.view.labels import Labels
from gateway.view.positions import is_shown, positions_in_metres
from gateway.view.trails import Trails

GHOST_S: Final = 1.0
"""How long the last place of a missing marker is shown."""

_SIZE_M: Final = 0.025
_GHOST_SIZE_M: Final = 0.015
_NOTHING: Final = np.empty((0, 3), np.float32)


class Markers:
    """The visible markers as points, and the last places of missing ones. ``path`` is the node above them."""

    def __init__(self, scene: viser.SceneApi, path: str, color: SourceColor) -> None:
        self._color = color
        self._points = _add_points(scene, f"{path}/markers", color.rgb, _SIZE_M)
        self._ghosts = _add_points(scene, f"{path}/missing markers", color.faint, _GHOST_SIZE_M)
        self._labels = Labels(scene, f"{path}/marker labels")
        self._trails = Trails(scene, f"{path}/trails", color.faint)
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
        self._show_stopped(component.is_stopped)
        self._show_ghosts(now_s)
        if labels:
            self._labels.update(self.positions, self._names, now_s, prefix)
        else:
            self._labels.hide()
        if trails and not self._is_stopped:
            self._trails.update(self.positions, now_s)
        else:
            self._trails.clear()

    def _show_stopped(self, stopped: bool) -> None:
        if stopped != self._is_stopped:
            self._is_stopped = stopped
            self._points.colors = np.array(GREY if stopped else self._color.rgb, np.uint8)

    def _show_ghosts(self, now_s: float) -> None:
        is_ghost = self._is_missing & (now_s - self._seen_s < GHOST_S) & (not self._is_stopped)
        if not np.array_equal(is_ghost, self._is_ghost):
            self._is_ghost = is_ghost
            self._ghosts.points = self._seen[is_ghost]

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


def _add_points(
    scene: viser.SceneApi, name: str, color: tuple[int, int, int], size_m: float
) -> viser.PointCloudHandle:
    return scene.add_point_cloud(
        name, _NOTHING, color, point_size=size_m, point_shape="circle", precision="float32"
    )
