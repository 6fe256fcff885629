"""The tools in the picture of a source."""

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import viser

from gateway.runtime.safe_text import safe_text
from gateway.takes.files.component_rows import Array
from gateway.tools.display.live import LiveComponent
from gateway.tools.display.view.scene_items import GREY, MAX_CHARACTERS, is_shown, positions_in_metres

MAX_TOOLS: Final = 300
"""How many tools of a source are shown."""

MAX_MOVED: Final = 40
"""How many tools are moved in one picture: each one costs as much as all markers."""

_THICKNESS_PX: Final = 4.0
_AXES: Final = np.stack([np.zeros((3, 3), np.float32), np.eye(3, dtype=np.float32)], axis=1)
_COLORS: Final = np.repeat(np.array([(225, 55, 55), (50, 165, 60), (55, 110, 240)], np.uint8), 2, axis=0)
_MOVED_M: Final = 0.0005
_TURNED: Final = 0.001
"""How much a tool must move, or one part of its quaternion change, to be moved in the picture."""

_MIN_NORM: Final = 1e-3
"""A quaternion that is shorter says nothing about the orientation."""


class _Node(NamedTuple):
    """A tool. The label is not below the frame: viser would draw it where the frame was before."""

    frame: viser.FrameHandle
    lines: viser.LineSegmentsHandle
    label: viser.LabelHandle


class Tools:
    """The visible tools as axes with labels. ``path`` is the node above them."""

    def __init__(self, scene: viser.SceneApi, path: str) -> None:
        self._scene = scene
        self._path = f"{path}/tools"
        for name in (self._path, f"{self._path} labels"):
            scene.add_frame(name, show_axes=False)
        self._nodes: list[_Node] = []
        self._poses = np.empty((0, 7))  # as they are shown: position and quaternion; NaN is hidden
        self._wanted = np.empty((0, 7))
        self._next = 0
        self._head: Any = None
        self._names: Sequence[str] = ()
        self._style: tuple[float, bool, bool] = (0.0, False, False)
        self._texts: list[str] = []
        self.positions: Array = np.empty((0, 3), np.float32)
        """The positions in the newest frame, shape (tools, 3), in metres; NaN is missing."""

    def update(self, component: LiveComponent, prefix: str, *, labels: bool, length_m: float) -> None:
        """Show the newest frame, with axes of this length. ``prefix`` precedes each label."""
        if component.newest_head is not self._head:
            self._head = component.newest_head
            self._take(component)
        first = len(self._nodes)
        for _ in range(first, min(len(self._wanted), first + MAX_MOVED)):
            self._add_node()
        style = (length_m, component.is_stopped, labels)
        for node in self._nodes[first if style == self._style else 0 :]:
            node.lines.points = _AXES * np.float32(length_m)
            node.lines.colors = np.array(GREY, np.uint8) if component.is_stopped else _COLORS.reshape(3, 2, 3)
            node.label.visible = labels and node.frame.visible
        self._style = style
        texts = [safe_text(prefix + name, MAX_CHARACTERS) for name in self._names[: len(self._nodes)]]
        if texts != self._texts:
            self._texts = texts
            for node, text in zip(self._nodes, texts, strict=False):
                node.label.text = text
        self._move()

    def _add_node(self) -> None:
        path = f"{self._path}/{len(self._nodes)}"
        frame = self._scene.add_frame(path, show_axes=False, visible=False)
        lines = self._scene.add_line_segments(
            f"{path}/axes", _AXES, GREY, thickness=_THICKNESS_PX, thickness_units="screen"
        )
        name = f"{self._path} labels/{len(self._nodes)}"
        label = self._scene.add_label(name, "", visible=False, anchor="bottom-left", font_screen_scale=1.0)
        self._nodes.append(_Node(frame, lines, label))
        self._poses = np.concatenate([self._poses, np.full((1, 7), np.nan)])

    def _move(self) -> None:
        """Move the tools that have moved, at most MAX_MOVED of them, in turns."""
        wanted = np.full_like(self._poses, np.nan)
        wanted[: len(self._wanted)] = self._wanted[: len(wanted)]
        change = abs(wanted - self._poses)
        has_moved = (change[:, :3] > _MOVED_M).any(axis=1) | (change[:, 3:] > _TURNED).any(axis=1)
        has_moved |= np.isnan(wanted[:, 0]) != np.isnan(self._poses[:, 0])
        indices = np.flatnonzero(has_moved).tolist()
        start = int(np.searchsorted(indices, self._next))
        for index in [*indices[start:], *indices[:start]][:MAX_MOVED]:
            (frame, _, label), pose = self._nodes[index], wanted[index]
            if visible := bool(np.isfinite(pose[0])):
                frame.position, frame.wxyz = pose[:3], pose[3:]
                label.position = pose[:3]
            frame.visible = visible
            label.visible = visible and self._style[2]
            self._poses[index] = pose
            self._next = index + 1

    def _take(self, component: LiveComponent) -> None:
        items = component.newest_items[:MAX_TOOLS]
        self._names = component.description.labels
        positions = positions_in_metres(items, component.description.unit)
        quaternions = np.stack([items[name] for name in ("q0", "qx", "qy", "qz")], axis=-1).astype(np.float64)
        norms = np.linalg.norm(quaternions, axis=1)
        is_valid = np.isfinite(norms) & (norms > _MIN_NORM)
        positions[~is_valid] = np.nan
        self.positions = positions
        self._wanted = np.full((len(items), 7), np.nan)
        shown = is_shown(positions)
        self._wanted[shown, :3] = positions[shown]
        self._wanted[shown, 3:] = quaternions[shown] / norms[shown, None]
