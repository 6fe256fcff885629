"""The links between markers in the picture of a source."""

from typing import Final

import numpy as np
import viser

from gateway.takes.files.component_rows import Array
from gateway.tools.display.live import LiveComponent
from gateway.tools.display.view.scene_items import COLORS, GREY, color_of, positions_in_metres
from gateway.tools.display.view.segments import NUM_FRAMES, LinkFinder, subject_of

SAMPLE_US: Final = 125_000
"""The frames from which links are found are so far apart."""

FIND_S: Final = 1.0
"""How often links are searched for while something moves."""

_NO_LINES: Final = np.empty((0, 2, 3), np.float32)


class Links:
    """Lines between the markers of a segment. ``path`` is the node above them.

    The first subject has the colour of the source with this ``number``, the others have the next ones.
    """

    def __init__(self, scene: viser.SceneApi, path: str, number: int) -> None:
        self._scene = scene
        self._path = path
        self._number = number
        self._nodes: list[viser.LineSegmentsHandle] = []  # one for each colour
        self._names: tuple[str, ...] = ()
        self._colors: Array = np.empty(0, int)  # the place of each marker's node in _nodes
        self._finder = LinkFinder(())
        self._links: Array = np.empty((0, 2), int)
        self._last_sample = 0  # its time, in SAMPLE_US
        self._find_due_s = 0.0
        self._is_stopped = False

    def update(self, component: LiveComponent, positions: Array, now_s: float, *, shown: bool) -> None:
        """Take the frames that have arrived, and draw the links at ``positions``, shape (markers, 3), in m.

        A link is hidden while one of its markers is missing. All are unless they are ``shown``.
        """
        names = component.description.labels
        if names is not self._names and names != self._names:
            self._take_names(names)
        self._names = names
        self._add(component)
        if now_s >= self._find_due_s:
            self._find_due_s = now_s + FIND_S
            self._links = self._finder.find()
        lines = positions[self._links] if shown else _NO_LINES
        colors = self._colors[self._links[: len(lines), 0]]
        is_visible = ~np.isnan(lines).any(axis=(1, 2))
        for number, node in enumerate(self._nodes):
            node.points = lines[is_visible & (colors == number)]
        if component.is_stopped != self._is_stopped:
            self._is_stopped = component.is_stopped
            self._set_colors()

    def _take_names(self, names: tuple[str, ...]) -> None:
        self._finder = LinkFinder(names)
        self._links = self._finder.find()
        numbers: dict[str, int] = {}
        subjects = [numbers.setdefault(subject_of(name), len(numbers)) for name in names]
        self._colors = np.array(subjects, int) % len(COLORS)
        for number in range(len(self._nodes), min(len(numbers), len(COLORS))):
            name = f"{self._path}/links {number}"
            node = self._scene.add_line_segments(
                name, _NO_LINES, GREY, thickness=1.5, thickness_units="screen"
            )
            self._nodes.append(node)
        self._set_colors()

    def _set_colors(self) -> None:
        for number, node in enumerate(self._nodes):
            color = GREY if self._is_stopped else color_of(self._number + number)
            node.colors = np.array(color, np.uint8)

    def _add(self, component: LiveComponent) -> None:
        """Give the finder frames that are SAMPLE_US apart; only the newest if many come at once."""
        rows, num_items = component.batch, len(self._names)
        if num_items not in rows.items:
            return
        samples = rows.heads["utime"][rows.heads["num_items"] == num_items] // SAMPLE_US
        is_new = np.diff(samples, prepend=self._last_sample) != 0
        self._last_sample = int(samples[-1])
        for items in rows.items[num_items][is_new][-NUM_FRAMES:]:
            self._finder.add(1000 * positions_in_metres(items, component.description.unit))
