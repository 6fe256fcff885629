"""Where markers were in the last second."""

from collections import deque
from typing import Final

import numpy as np
import viser

from gateway.takes.component_rows import Array

LENGTH_S: Final = 1.0
MAX_SEGMENTS: Final = 5000
"""How many segments all trails of a source have together; with many markers, trails are shorter."""

_STEP_S: Final = 1 / 15


class Trails:
    """The trails of the markers of a source, drawn 15 times a second."""

    def __init__(self, scene: viser.SceneApi, name: str, color: tuple[int, int, int]) -> None:
        self._node = scene.add_line_segments(
            name, np.empty((0, 2, 3), np.float32), color, thickness=1.5, thickness_units="screen"
        )
        self._history: deque[tuple[float, Array]] = deque()

    def update(self, positions: Array, now_s: float) -> None:
        """Take the positions of a frame, shape (markers, 3); NaN interrupts a trail."""
        if self._history and now_s - self._history[-1][0] < _STEP_S:
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
            self._node.points = np.empty((0, 2, 3), np.float32)
