"""How often each marker or tool was visible in the last seconds."""

from collections import deque
from typing import Final

import numpy as np

from gateway.takes.component_rows import Array

WINDOW_S: Final = 10.0
_STEP_S: Final = 0.5


def visible_percent(share: float) -> float:
    """Return a share from 0 to 1 in %, for one decimal: only 0 and 1 themselves become 0.0 and 100.0."""
    return 100 * share if share in {0, 1} else min(max(100 * share, 0.1), 99.9)


class Visibility:
    """Counts in steps of half a second, over WINDOW_S, in how many frames each item was visible."""

    def __init__(self) -> None:
        self._steps: deque[tuple[float, int, Array]] = deque()  # begin, number of frames, visible frames

    def add(self, is_visible: Array, now_s: float) -> None:
        """Take frames; ``is_visible`` has the shape (frames, items).

        If the number of items changes, counting starts again.
        """
        self._forget(now_s)
        num_frames, num_items = is_visible.shape
        if self._steps and len(self._steps[-1][2]) != num_items:
            self._steps.clear()
        counts = is_visible.sum(axis=0)
        if self._steps and now_s - self._steps[-1][0] < _STEP_S:
            begin_s, former_frames, former_counts = self._steps.pop()
            self._steps.append((begin_s, former_frames + num_frames, former_counts + counts))
        else:
            self._steps.append((now_s, num_frames, counts))

    def shift(self, seconds: float) -> None:
        """Let everything so far have happened later: a pause does not count."""
        self._steps = deque((begin_s + seconds, frames, counts) for begin_s, frames, counts in self._steps)

    def shares(self, now_s: float) -> Array:
        """Return for each item the share of frames in which it was visible, from 0 to 1, shape (items,).

        The shape is (0,) if no frame came within WINDOW_S.
        """
        self._forget(now_s)
        num_frames = sum(frames for _, frames, _ in self._steps)
        if not num_frames:
            return np.zeros(0)
        total: Array = np.sum([counts for _, _, counts in self._steps], axis=0)
        return total / num_frames

    def _forget(self, now_s: float) -> None:
        while self._steps and now_s - self._steps[0][0] > WINDOW_S:
            self._steps.popleft()
