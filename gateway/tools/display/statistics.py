"""Statistics of what arrives for a display: how often items are visible, and latencies."""

from collections import deque
from typing import Any, Final, NamedTuple

import numpy as np

from gateway.takes.files.component_rows import Array

WINDOW_S: Final = 10.0
_STEP_S: Final = 0.5


def visible_percent(share: float) -> float:
    """Return a share from 0 to 1 in %, for one decimal: only 0 and 1 themselves become 0.0 and 100.0."""
    return 100 * share if share in {0, 1} else min(max(100 * share, 0.1), 99.9)


class Visibility:
    """Counts in steps of half a second, over WINDOW_S, in how many frames each item was visible."""

    def __init__(self) -> None:
        self._steps: deque[tuple[float, int, Array]] = deque()  # begin, number of frames, visible frames

    def add(self, is_visible: Array, times_s: Array) -> None:
        """Take frames with their times; ``is_visible`` has the shape (frames, items).

        If the number of items changes, counting starts again.
        """
        steps = np.flatnonzero(np.diff(times_s // _STEP_S)) + 1
        for frames, step_s in zip(np.split(is_visible, steps), np.split(times_s, steps), strict=True):
            self._add_step(frames, float(step_s[0]))

    def _add_step(self, is_visible: Array, now_s: float) -> None:
        self._forget(now_s)
        num_frames, num_items = is_visible.shape
        if self._steps and len(self._steps[-1][2]) != num_items:
            self._steps.clear()
        begin_s, counts = now_s, is_visible.sum(axis=0)
        if self._steps and now_s - self._steps[-1][0] < _STEP_S:
            begin_s, former_frames, former_counts = self._steps.pop()
            num_frames, counts = former_frames + num_frames, former_counts + counts
        self._steps.append((begin_s, num_frames, counts))

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


_NUM_SAMPLES: Final = 2000
_NUM_SHOWN: Final = 300
"""10 s at 30 pictures per second."""


class Percentiles(NamedTuple):
    """Percentiles of a latency, in milliseconds."""

    p50_ms: float
    p99_ms: float

    @classmethod
    def of(cls, samples_ms: Any) -> "Percentiles | None":
        """Return the percentiles of a sequence of samples; None if it is empty."""
        return cls(*np.percentile(samples_ms, (50, 99)).tolist()) if len(samples_ms) else None


class Latency:
    """The latencies of the newest messages, at most 2000, by stage.

    Latencies to this computer are on two clocks if the gateway runs on another computer, and then they are
    only as exact as these clocks agree. They may be negative.
    """

    def __init__(self) -> None:
        self._samples = np.zeros((_NUM_SAMPLES, 2))  # ms from capture to the gateway, and from there to here
        self._num_added = 0
        self.shown_ms: deque[float] = deque(maxlen=_NUM_SHOWN)
        """From the arrival at this program to the browsers, of what they have shown."""

    def add(self, capture_utime: Array, utime: Array, arrived_utime: Array) -> None:
        """Take the times of messages, each with the shape (messages,), in µs since the Unix epoch."""
        times = np.stack([capture_utime, utime, arrived_utime]).astype(np.float64)[:, -_NUM_SAMPLES:]
        places = (self._num_added + np.arange(times.shape[1])) % _NUM_SAMPLES
        self._samples[places] = np.diff(times, axis=0).T / 1000
        self._num_added += times.shape[1]

    @property
    def to_gateway(self) -> Percentiles | None:
        """From the capture to the arrival at the gateway; None before the first message."""
        return Percentiles.of(self._samples[: self._num_added, 0])

    @property
    def to_here(self) -> Percentiles | None:
        """From the arrival at the gateway to the arrival at this program; None before the first message."""
        return Percentiles.of(self._samples[: self._num_added, 1])
