"""The tools of a source."""

from typing import Any, Final

import numpy as np
import viser

from gateway.live.component import LiveComponent
from gateway.takes.component_rows import Array
from gateway.view.labels import Labels
from gateway.view.positions import is_shown, positions_in_metres

_AXES_M: Final = 0.15
_RADIUS_M: Final = 0.005
_STOPPED_SIZE: Final = 0.3
_MIN_NORM: Final = 1e-3
"""A quaternion that is shorter says nothing about the orientation."""

_NOTHING: Final = np.empty((0, 3), np.float32)


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
        self._show_sizes(_STOPPED_SIZE if component.is_stopped else 1.0)
        if labels:
            self._labels.update(self.positions, self._names, now_s, prefix)
        else:
            self._labels.hide()

    def _show_sizes(self, size: float) -> None:
        """Hide missing tools: their size is 0."""
        sizes = is_shown(self.positions) * np.float32(size)
        if self._axes is not None and not np.array_equal(sizes, self._sizes):
            self._sizes = sizes
            self._axes.batched_scales = sizes

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
        if self._axes is None or len(self._axes.batched_positions) != len(items):
            self._axes = self._add_axes(turned, places)
        else:
            self._axes.batched_wxyzs = turned
            self._axes.batched_positions = places

    def _add_axes(self, quaternions: Array, positions: Array) -> viser.BatchedAxesHandle:
        """Replace the axes, because the number of tools is another one."""
        self._sizes = np.zeros(len(positions), np.float32)
        return self._scene.add_batched_axes(
            self._name,
            quaternions,
            positions,
            self._sizes,
            axes_length=_AXES_M,
            axes_radius=_RADIUS_M,
            visible=len(positions) > 0,
        )
