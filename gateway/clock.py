"""Server time → host time, from nothing but the frames' time stamps and when they came.

A frame's arrival is ``offset + (1 + drift) * stamp + delay``, and the delay is never below that of an idle
network. So the frames that came soonest tell the clocks, and the others tell only that they were late:

1. Of each half second of frames the one with the least delay is kept, for 30 s: minimum filtering, because
   averages follow the jitter and the least delay does not.
2. Offset and drift are the line below all kept frames with the least sum of distances to them. Its slope is
   that of the edge of their lower convex hull above their mean time stamp (Zhang, Liu, Xia: "Clock
   synchronization algorithms for network measurements", INFOCOM 2002, after the linear programme of Moon, Skelly,
   Towsley, INFOCOM 1999; for sensors, Olson: "A passive solution to the sensor synchronization problem", IROS
   2010). Below 5 s of frames the drift is not told from jitter, and stays as it was.
3. A frame that comes before the line proves it wrong at once: the line moves down to it. One that is far before
   shows a step of a clock, and what was kept is dropped. A crystal keeps its rate, so the drift stays.
4. A frame that comes late proves nothing: a pause, a jam or a step. Half seconds that are late throughout
   are kept apart, and believed when they are equally late for two seconds (a jam is not), or late for 30 s.
5. A time stamp or frame number that goes back is a new time base and a new line through that frame, except where
   the stamp is just 32 bits short (field note 11). Stamps that stand still, or whose rate no crystal has,
   are no clock.

What cannot be known from one side is the least delay itself: it stays in every time told here.
"""

import math
from collections import deque
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

WINDOW_US: Final = 500_000
"""Of this much time the frame with the least delay is kept."""

KEPT_WINDOWS: Final = 60
"""How many are kept: 30 s. Crystals change their rate over minutes, with the room's temperature."""

MAX_DRIFT: Final = 500e-6
"""No crystal is worse; a greater drift means that the stamps are no µs."""

_MIN_SAMPLES: Final = 3
_DRIFT_SPAN_US: Final = 5_000_000
_STEP_US: Final = 2_000
_STEP_WINDOWS: Final = 4
_RATE_TOLERANCE_US: Final = 10_000
_FROZEN_US: Final = 500_000
_WRAP_US: Final = 1 << 32
_WRAP_TOLERANCE_US: Final = 1_000_000
_NEVER: Final = 1 << 63  # above every time stamp
_LATER: Final = math.inf


class Reading(NamedTuple):
    """What one frame says: when it was captured (µs since the Unix epoch), and how late it came.

    ``capture_utime`` is never later than the arrival. ``lag_s`` is the arrival minus the earliest one
    possible, at least 0, and 0 while there is no clock. ``restarted`` tells that this frame is the first of
    another time base.
    """

    capture_utime: int
    lag_s: float
    restarted: bool


class _Sample(NamedTuple):
    """A frame of least delay: its time stamp, and its arrival minus that."""

    timestamp_us: int
    offset_us: int


class ServerClock:
    """The clock of one server as its frames tell it; see the module for how.

    ``has_clock`` is False until 1.5 s of stamps made sense, and whenever they do not.
    """

    def __init__(self) -> None:
        self.has_clock = False
        self._samples: deque[_Sample] = deque(maxlen=KEPT_WINDOWS)
        self._late: deque[_Sample] = deque(maxlen=KEPT_WINDOWS)
        self._drift = 0.0
        self._scatter_us = math.inf
        # The line: the host time of one time stamp, from where it rises with 1 + drift.
        self._base_timestamp_us = 0
        self._base_utime = 0
        # The frame before.
        self._timestamp_us = _NEVER
        self._frame_number = 0
        self._arrival_utime = 0
        self._capture_utime = 0
        # Since when the stamp has not moved, and for how many frames.
        self._still_utime = 0
        self._still_frames = 0
        # The frame with the least delay of this window.
        self._window_end_utime = 0
        self._least_lag_us: float = _LATER
        self._least = _Sample(0, 0)

    @property
    def offset_us(self) -> int:
        """Host time minus server time at the newest frame, in µs; 0 while there is no clock."""
        if not self.has_clock:
            return 0
        elapsed_us = self._timestamp_us - self._base_timestamp_us
        return self._base_utime - self._base_timestamp_us + int(self._drift * elapsed_us)

    @property
    def drift_ppm(self) -> float:
        """How much faster the host's clock runs than the server's, in ppm; 0 while there is no clock."""
        return self._drift * 1e6 if self.has_clock else 0.0

    @property
    def uncertainty_us(self) -> float:
        return self._scatter_us

    @property
    def samples(self) -> int:
        """How many frames of least delay the line rests on."""
        return len(self._samples)

    def observe(self, timestamp_us: int, frame_number: int, arrival_utime: int) -> Reading:
        """Return what the frame says that came at ``arrival_utime`` (µs since the Unix epoch)."""
        restarted = False
        if timestamp_us <= self._timestamp_us or frame_number < self._frame_number:
            restarted = self._stands_or_goes_back(timestamp_us, frame_number, arrival_utime)
        elif arrival_utime >= self._window_end_utime:
            self._close_window(arrival_utime)
        self._timestamp_us = timestamp_us
        self._frame_number = frame_number
        self._arrival_utime = arrival_utime

        elapsed_us = timestamp_us - self._base_timestamp_us
        earliest_utime = self._base_utime + elapsed_us + int(self._drift * elapsed_us)
        lag_us = arrival_utime - earliest_utime
        if lag_us < self._least_lag_us:
            if lag_us < 0:
                self._came_early(timestamp_us, arrival_utime, -lag_us)
                earliest_utime = arrival_utime
                lag_us = 0
            self._least_lag_us = lag_us
            self._least = _Sample(timestamp_us, arrival_utime - timestamp_us)

        if not self.has_clock:
            self._capture_utime = arrival_utime
            return Reading(arrival_utime, 0.0, restarted)
        if earliest_utime < self._capture_utime:
            earliest_utime = min(self._capture_utime, arrival_utime)
        self._capture_utime = earliest_utime
        return Reading(earliest_utime, lag_us * 1e-6, restarted)

    def _came_early(self, timestamp_us: int, arrival_utime: int, early_us: int) -> None:
        if early_us > _STEP_US:
            self._begin(arrival_utime)
        self._base_timestamp_us, self._base_utime = timestamp_us, arrival_utime

    def _begin(self, arrival_utime: int) -> None:
        """Forget the samples, not the drift."""
        self._samples.clear()
        self._late.clear()
        self._scatter_us = math.inf
        self._window_end_utime = arrival_utime + WINDOW_US
        self._least_lag_us = _LATER

    def _restart(self, timestamp_us: int, arrival_utime: int, *, has_clock: bool) -> None:
        self.has_clock = has_clock
        if not has_clock:
            self._drift = 0.0
        self._begin(arrival_utime)
        self._base_timestamp_us, self._base_utime = timestamp_us, arrival_utime
        self._still_frames = 0

    def _stands_or_goes_back(self, timestamp_us: int, frame_number: int, arrival_utime: int) -> bool:
        """Take a frame that does not follow the one before; return whether it begins another time base."""
        if self._timestamp_us == _NEVER:
            self._restart(timestamp_us, arrival_utime, has_clock=False)
            return False
        if frame_number >= self._frame_number:
            if timestamp_us == self._timestamp_us:
                self._stand_still(timestamp_us, arrival_utime)
                return False
            advance_us = timestamp_us - self._timestamp_us + _WRAP_US
            elapsed_us = arrival_utime - self._arrival_utime
            if advance_us > 0 and abs(advance_us - elapsed_us) < _WRAP_TOLERANCE_US:
                self._wrap()
                return False
        self._restart(timestamp_us, arrival_utime, has_clock=self.has_clock and len(self._samples) > 0)
        return True

    def _stand_still(self, timestamp_us: int, arrival_utime: int) -> None:
        if self._still_frames == 0:
            self._still_utime = self._arrival_utime
        self._still_frames += 1
        if self._still_frames > 1 and arrival_utime - self._still_utime > _FROZEN_US:
            self._restart(timestamp_us, arrival_utime, has_clock=False)

    def _wrap(self) -> None:
        self._base_timestamp_us -= _WRAP_US
        self._least = _wrapped(self._least)
        for samples in (self._samples, self._late):
            wrapped = [_wrapped(sample) for sample in samples]
            samples.clear()
            samples.extend(wrapped)

    def _close_window(self, arrival_utime: int) -> None:
        lag_us, sample = self._least_lag_us, self._least
        self._window_end_utime = arrival_utime + WINDOW_US
        self._least_lag_us = _LATER
        if lag_us == _LATER:
            return
        if self.has_clock and lag_us > _STEP_US + 4 * self._scatter_us:
            self._late.append(sample)
            offsets_us = [late.offset_us for late in self._late]
            level = len(offsets_us) >= _STEP_WINDOWS and max(offsets_us) - min(offsets_us) < _STEP_US
            if not level and len(offsets_us) < KEPT_WINDOWS:
                return
            self._samples, self._late = self._late, self._samples
        else:
            self._samples.append(sample)
        self._late.clear()
        self._fit()

    def _fit(self) -> None:
        samples = self._samples
        base_us = samples[-1].timestamp_us
        span_us = base_us - samples[0].timestamp_us
        if len(samples) >= _MIN_SAMPLES:
            slope = envelope_slope(samples)
            self.has_clock = abs(slope) <= MAX_DRIFT + _RATE_TOLERANCE_US / span_us
            if not self.has_clock:
                self._drift = 0.0
            elif span_us >= _DRIFT_SPAN_US:
                self._drift = min(max(slope, -MAX_DRIFT), MAX_DRIFT)
        heights_us = [
            offset_us - self._drift * (timestamp_us - base_us) for timestamp_us, offset_us in samples
        ]
        least_us = min(heights_us)
        self._base_timestamp_us = base_us
        self._base_utime = base_us + math.floor(least_us)
        if len(samples) >= _MIN_SAMPLES:
            self._scatter_us = (sum(heights_us) - len(samples) * least_us) / (len(samples) - 2)


def _wrapped(sample: _Sample) -> _Sample:
    return _Sample(sample.timestamp_us - _WRAP_US, sample.offset_us + _WRAP_US)


def envelope_slope(samples: Sequence[_Sample]) -> float:
    """Return the slope of the lower convex hull's edge above the mean time stamp."""
    hull: list[_Sample] = []
    for sample in samples:
        while len(hull) >= 2 and not _turns_up(hull[-2], hull[-1], sample):
            hull.pop()
        hull.append(sample)
    mean_us = sum(s.timestamp_us for s in samples) / len(samples)
    left, right = next((a, b) for a, b in pairwise(hull) if b.timestamp_us >= mean_us)
    return (right.offset_us - left.offset_us) / (right.timestamp_us - left.timestamp_us)


def _turns_up(first: _Sample, second: _Sample, third: _Sample) -> bool:
    rise_us = (second.offset_us - first.offset_us) * (third.timestamp_us - first.timestamp_us)
    return rise_us < (third.offset_us - first.offset_us) * (second.timestamp_us - first.timestamp_us)
