"""Labels of markers, tools and plates."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import viser

from gateway.safe_text import safe_text
from gateway.takes.component_rows import Array
from gateway.view.positions import is_shown

MAX_LABELS: Final = 300
"""How many items of one kind have labels."""

_MAX_CHARACTERS: Final = 100
"""How much of a label is drawn. Labels come from the network."""

_PERIOD_S: Final = 1 / 15
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

    def update(self, positions: Array, texts: Sequence[str], now_s: float, prefix: str = "") -> None:
        """Show the labels at ``positions``, shape (items, 3), not all at a time; NaN hides one.

        ``prefix`` precedes each text.
        """
        if now_s - self._moved_s < _PERIOD_S:
            return
        self._moved_s = now_s
        self._parent.visible = True
        count = min(MAX_LABELS, len(positions), len(texts))
        self._add_nodes(count)
        if texts is not self._texts or prefix != self._prefix:
            self._texts, self._prefix = texts, prefix
            for index, node in enumerate(self._nodes[: len(texts)]):
                node.text = self._text(index)
        wanted = np.full_like(self._positions, np.nan)
        wanted[:count] = positions[: len(wanted)][:count]
        differs = is_shown(wanted) != is_shown(self._positions)
        differs |= (abs(wanted - self._positions) > _MOVED_M).any(axis=1)
        (indices,) = np.nonzero(differs)
        first = int(np.searchsorted(indices, self._next))
        for index in [*indices[first:], *indices[:first]][:_PER_PERIOD]:
            self._move(int(index), wanted[index])

    def hide(self) -> None:
        """Hide all labels."""
        self._parent.visible = False

    def _add_nodes(self, count: int) -> None:
        first = len(self._nodes)
        for index in range(first, min(count, first + _PER_PERIOD)):
            text = self._text(index) if index < len(self._texts) else ""
            name = f"{self._parent.name}/{index}"
            self._nodes.append(
                self._scene.add_label(name, text, visible=False, font_screen_scale=0.8, anchor="bottom-left")
            )
        added = np.full((len(self._nodes) - first, 3), np.nan, np.float32)
        self._positions = np.concatenate([self._positions, added])

    def _text(self, index: int) -> str:
        return safe_text(self._prefix + self._texts[index], _MAX_CHARACTERS)

    def _move(self, index: int, position: Array) -> None:
        node = self._nodes[index]
        visible = bool(np.isfinite(position[0]))
        if visible:
            node.position = position
        node.visible = visible
        self._positions[index] = position
        self._next = index + 1
