"""Statistics of what arrives for a display: its rate, how often items are visible, and latencies."""

import time
from collections import deque
from typing import Any, Final, NamedTuple

import numpy as np

from gateway.takes.files.component_rows import Array


class HeldClock:
    """The monotonic clock, but while a recording pauses, it stands still."""

    def __init__(self) -> None:
        self._held_s = 0.0  # how long it was held so far
        self._continued_s = self.now_s

    @property
    def now_s(self) -> float:
        """The time without pauses."""
        return time.monotonic() - self._held_s

    def go_on(self) -> float:
        """Return the time, and let it count even if ``hold`` follows."""
        self._continued_s = self.now_s
        return self._continued_s

    def hold(self) -> None:
        """Count no time since the last ``go_on``."""
        self._held_s += self.now_s - self._continued_s


_RATE_WINDOW_S: Final = 2.0

_STOPPED_S: Final = 0.5
"""Data that do not come for this long, and for _STOPPED_FRAMES frames, have stopped."""
_STOPPED_FRAMES: Final = 4


class ArrivalRate:
    """How many messages come per second, over two seconds, and whether they have stopped."""

    def __init__(self) -> None:
        self._counts: deque[tuple[float, int]] = deque()  # time and number of messages so far
        self._newest_s: float | None = None
        self._rate_before_stop_hz = 0.0

    def count(self, now_s: float, num_messages: int) -> None:
        """Take messages that arrive now; also call it when none arrive."""
        num_before = self._counts[-1][1] if self._counts else 0
        self._counts.append((now_s, num_before + num_messages))
        while len(self._counts) > 2 and now_s - self._counts[1][0] >= _RATE_WINDOW_S:
            self._counts.popleft()

    def count_past(self, times_s: Array) -> None:
        """Let the rate be that of the times of messages of the past; ``times_s`` are those on this clock."""
        recent_s = times_s[times_s > times_s[-1:] - _RATE_WINDOW_S].tolist()
        if recent_s:
            self._counts = deque([(recent_s[0], 0), (recent_s[-1], len(recent_s) - 1)])

    def note_newest(self, newest_s: float) -> None:
        """Take the time of the newest message, after it was counted."""
        self._newest_s = newest_s
        self._rate_before_stop_hz = self.rate_hz

    @property
    def rate_hz(self) -> float:
        """How many messages come per second; 0 before the second call of ``count``."""
        if len(self._counts) < 2:
            return 0.0
        (first_s, first), (last_s, last) = self._counts[0], self._counts[-1]
        return (last - first) / max(last_s - first_s, 1e-3)

    def age_s(self, now_s: float) -> float | None:
        """Return how long ago the newest message came; None before the first."""
        return None if self._newest_s is None else now_s - self._newest_s

    def have_stopped(self, now_s: float) -> bool:
        """Return whether messages came before and come no more."""
        age_s = self.age_s(now_s)
        if age_s is None:
            return False
        frames_s = _STOPPED_FRAMES / self._rate_before_stop_hz if self._rate_before_stop_hz else 0.0
        return age_s > max(_STOPPED_S, frames_s)


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
