"""Server time → host time, from nothing but the frames' time stamps and when they came.

A frame comes at ``offset + (1 + drift) * time stamp + delay``, and its delay is never below that of an idle
network. So the frames that came soonest tell the clocks, and the others tell only that they were late:

1. Of every half second the frame with the least delay is kept, for 30 s. This is minimum filtering: a mean
   would follow the jitter.
2. The line below all kept frames with the least sum of distances to them is the clock: it is the most likely
   one if delays are exponential. Its slope is that of the edge of their lower convex hull above their mean
   time stamp (Zhang, Liu, Xia, "Clock synchronization algorithms for network measurements", INFOCOM 2002;
   before it the linear programme of Moon, Skelly, Towsley, INFOCOM 1999; for sensors Olson, "A passive
   solution to the sensor synchronization problem", IROS 2010). In less than 5 s a drift cannot be told
   from jitter; until then it stays as it was.
3. A frame before the line proves it wrong: the line moves down to it at once. Far before means that a clock
   was set: what was kept is void. The drift stays, because nobody sets a crystal's rate.
4. A late frame proves nothing: a pause, a jam, or a clock that was set. Half seconds that are late
   throughout are kept apart, and believed once they are equally late for two seconds, which a jam that
   grows or clears is not, or late for 30 s.
5. A time stamp or frame number that goes back is a new time base, with a new line through that frame at
   once; a stamp that is just 2^32 µs short has wrapped around, and the line goes on (field note 11). Stamps
   that stand still, or run at a rate that no crystal has, are no clock.

The least delay itself cannot be known from one side: it is in every time told here.
"""

import math
from collections import deque
from collections.abc import Sequence
from itertools import islice, pairwise
from typing import Final, NamedTuple

MAX_DRIFT: Final = 500e-6
"""Crystals are within 100e-6 of their rate. Beyond this, the stamps are not µs of a clock."""

_WINDOW_US: Final = 500_000
"""Of each window the frame with the least delay is kept: 15 frames at 30 Hz are enough to choose from."""

_KEPT_WINDOWS: Final = 60
"""More would tell a constant drift better, and one that changes with the room's temperature worse."""

_LEAST_SAMPLES: Final = 3
"""Through two frames there is always a line; the third tells whether it is one."""

_DRIFT_SPAN_US: Final = 5_000_000
"""A drift of 100 ppm is 0.5 ms by then, more than the least delays of half seconds differ."""

_RATE_TOLERANCE_US: Final = 10_000
"""By how much least delays may differ: what a slope may be beyond MAX_DRIFT, times its span."""

_STEP_US: Final = 2_000
"""The least that shows a clock that was set; what is less passes with the frames that are kept."""

_STEP_WINDOWS: Final = 4
_ROUNDING_US: Final = 2.0  # time stamps and arrivals are whole µs
_FROZEN_US: Final = 500_000
_WRAP_US: Final = 1 << 32
_WRAP_TOLERANCE_US: Final = 1_000_000
_NO_TIMESTAMP_US: Final = 1 << 63  # none is as great: they are signed and have 64 bits


class Sample(NamedTuple):
    """A frame with the least delay of its window: its time stamp, and by how much it came after that."""

    timestamp_us: int
    offset_us: int


class ServerClock:
    """The clock of one server, learned from its frames as the module tells.

    While ``has_clock`` is False (in the first 1.5 s, and whenever time stamps make no sense)
    ``capture_utime`` is the arrival. It does not go back from frame to frame of a time base unless the
    arrivals do; two frames may have the same.
    """

    def __init__(self) -> None:
        self.has_clock = False
        self._samples: deque[Sample] = deque(maxlen=_KEPT_WINDOWS)
        self._late_samples: deque[Sample] = deque(maxlen=_KEPT_WINDOWS)
        self._scatter_us = math.inf
        # The line: the host time of one time stamp, and by how much more than 1 it rises from there.
        self._line_timestamp_us = self._line_utime = 0
        self._drift = 0.0
        # The frame before.
        self._timestamp_us = _NO_TIMESTAMP_US
        self._frame_number = self._arrival_utime = self._capture_utime = 0
        # What 32 bits have lost of the time stamps; the line and the samples are in whole ones.
        self._wrapped_us = 0
        # The time stamp that was last seen twice in a row, and when it came first.
        self._repeated_us = _NO_TIMESTAMP_US
        self._repeated_utime = 0
        # The window under way, and the frame with the least delay in it.
        self._window_end_utime = 0
        self._least_lag_us: float = math.inf
        self._least_timestamp_us = self._least_offset_us = 0

    @property
    def offset_us(self) -> int:
        """Host time minus server time at the last frame, µs; 0 without a clock."""
        if not self.has_clock:
            return 0
        elapsed_us = self._timestamp_us + self._wrapped_us - self._line_timestamp_us
        capture_utime = self._line_utime + elapsed_us + int(self._drift * elapsed_us)
        return capture_utime - self._timestamp_us

    @property
    def drift_ppm(self) -> float:
        """By how much the host's clock is faster than the server's; 0 without a clock."""
        return self._drift * 1e6 if self.has_clock else 0.0

    @property
    def uncertainty_us(self) -> float:
        """By how much the least delays of half seconds differ, which errors seldom exceed.

        It is inf without a clock, and until three half seconds tell it. What all frames have in common, the
        network's least delay, is not in it.
        """
        return self._scatter_us if self.has_clock else math.inf

    @property
    def samples(self) -> int:
        """On how many frames of least delay the line rests, at most 60."""
        return len(self._samples)

    def observe(self, timestamp_us: int, frame_number: int, arrival_utime: int) -> tuple[int, float, bool]:
        """Learn from the frame that came at ``arrival_utime``; return its (capture_utime, lag_s, restarted).

        ``capture_utime`` is when it was captured, µs since the Unix epoch, never later than it came.
        ``lag_s`` is by how much it came later than the soonest possible, at least 0, and 0 without a clock.
        ``restarted`` tells that with this frame the server's time or frame numbers began anew.

        Called once per frame, in the order in which frames came. ``timestamp_us`` and ``frame_number`` are
        those of one of its components (§7.1), at best always of the same type: servers may count types apart,
        and a number that goes back is a restart. ``arrival_utime`` is µs since the Unix epoch.
        """
        restarted = False
        if timestamp_us <= self._timestamp_us or frame_number < self._frame_number:
            restarted = self._take_irregular(timestamp_us, frame_number, arrival_utime)
        elif arrival_utime >= self._window_end_utime:
            self._close_window(arrival_utime)
        self._timestamp_us = timestamp_us
        self._frame_number = frame_number
        self._arrival_utime = arrival_utime

        server_us = timestamp_us + self._wrapped_us
        elapsed_us = server_us - self._line_timestamp_us
        capture_utime = self._line_utime + elapsed_us + int(self._drift * elapsed_us)
        lag_us = arrival_utime - capture_utime
        if lag_us < self._least_lag_us:
            if lag_us < 0:
                if lag_us < -_STEP_US:
                    self._forget_samples(arrival_utime)
                self._line_timestamp_us, self._line_utime = server_us, arrival_utime
                capture_utime = arrival_utime
                lag_us = 0
            self._least_lag_us = float(lag_us)
            self._least_timestamp_us, self._least_offset_us = server_us, arrival_utime - server_us

        if not self.has_clock:
            self._capture_utime = arrival_utime
            return arrival_utime, 0.0, restarted
        # A new line may be below the one before; a subscriber's time is not to go back for that.
        if capture_utime < self._capture_utime:
            capture_utime = min(self._capture_utime, arrival_utime)
        self._capture_utime = capture_utime
        return capture_utime, lag_us * 1e-6, restarted

    def _take_irregular(self, timestamp_us: int, frame_number: int, arrival_utime: int) -> bool:
        """Prepare for a frame that is the first or does not follow the last; return whether it restarts."""
        if self._timestamp_us == _NO_TIMESTAMP_US:
            self._start(timestamp_us, arrival_utime, has_clock=False)
            return False
        if frame_number >= self._frame_number:
            if timestamp_us == self._timestamp_us:
                self._take_repeated(timestamp_us, arrival_utime)
                return False
            advance_us = timestamp_us + _WRAP_US - self._timestamp_us
            elapsed_us = arrival_utime - self._arrival_utime
            if advance_us > 0 and abs(advance_us - elapsed_us) < _WRAP_TOLERANCE_US:
                self._wrapped_us += _WRAP_US
                return False
        # A server that had a clock is trusted to have one again, unless it restarts all the time.
        self._start(timestamp_us, arrival_utime, has_clock=self.has_clock and len(self._samples) > 0)
        return True

    def _start(self, timestamp_us: int, arrival_utime: int, *, has_clock: bool) -> None:
        """Begin a line through this frame."""
        self.has_clock = has_clock
        self._wrapped_us = 0
        self._line_timestamp_us, self._line_utime = timestamp_us, arrival_utime
        self._forget_samples(arrival_utime)

    def _forget_samples(self, arrival_utime: int) -> None:
        self._samples.clear()
        self._scatter_us = math.inf
        self._begin_window(arrival_utime)

    def _begin_window(self, arrival_utime: int) -> None:
        self._window_end_utime = arrival_utime + _WINDOW_US
        self._least_lag_us = math.inf

    def _take_repeated(self, timestamp_us: int, arrival_utime: int) -> None:
        # A doubled frame, or coarse stamps, go on being a clock; a stamp that stays does not.
        if timestamp_us != self._repeated_us:
            self._repeated_us, self._repeated_utime = timestamp_us, self._arrival_utime
        if arrival_utime - self._repeated_utime > _FROZEN_US:
            self._start(timestamp_us, arrival_utime, has_clock=False)

    def _close_window(self, arrival_utime: int) -> None:
        """Judge the least delay of the window before this frame, and draw the line anew."""
        lag_us = self._least_lag_us
        least = Sample(self._least_timestamp_us, self._least_offset_us)
        self._begin_window(arrival_utime)
        doubt_us = _STEP_US + 4 * self._scatter_us
        if lag_us < doubt_us:
            self._samples.append(least)
        else:
            self._late_samples.append(least)
            if not self._is_late_for_good(min(lag_us / 4, doubt_us)):
                return
            self._samples = self._late_samples.copy()
        self._late_samples.clear()
        self._draw_line()

    def _is_late_for_good(self, tolerance_us: float) -> bool:
        late = self._late_samples
        if len(late) < _STEP_WINDOWS:
            return False
        newest = islice(reversed(late), _STEP_WINDOWS)
        spread_us = max(sample.offset_us for sample in newest) - min(sample.offset_us for sample in late)
        return spread_us < tolerance_us or len(late) == _KEPT_WINDOWS

    def _draw_line(self) -> None:
        """Put the line below the samples, and tell whether it is that of a clock."""
        samples = self._samples
        last = samples[-1]
        span_us = last.timestamp_us - samples[0].timestamp_us
        judged = len(samples) >= _LEAST_SAMPLES
        if judged:
            slope = envelope_slope(samples)
            self.has_clock = abs(slope) <= MAX_DRIFT + _RATE_TOLERANCE_US / span_us
            if span_us >= _DRIFT_SPAN_US:
                self._drift = min(max(slope, -MAX_DRIFT), MAX_DRIFT)
        heights_us = [
            offset_us - last.offset_us - self._drift * (timestamp_us - last.timestamp_us)
            for timestamp_us, offset_us in samples
        ]
        least_us = min(heights_us)
        self._line_timestamp_us = last.timestamp_us
        self._line_utime = last.timestamp_us + last.offset_us + math.floor(least_us)
        if judged:
            # The line was chosen so as to touch two of them: they tell nothing of the scatter.
            scatter_us = sum(height_us - least_us for height_us in heights_us) / (len(samples) - 2)
            self._scatter_us = max(scatter_us, _ROUNDING_US)


def envelope_slope(samples: Sequence[Sample]) -> float:
    """Return the slope of the line below all samples with the least sum of distances to them.

    ``samples`` are at least two, their time stamps strictly increasing. Of the lines below them all, one
    through an edge of the lower convex hull is nearest on the whole: that above the mean time stamp.
    """
    hull: list[Sample] = []
    for sample in samples:
        while len(hull) > 1 and not _turns_up(hull[-2], hull[-1], sample):
            hull.pop()
        hull.append(sample)
    mean_us = sum(sample.timestamp_us for sample in samples) / len(samples)
    left, right = next(edge for edge in pairwise(hull) if edge[1].timestamp_us >= mean_us)
    return (right.offset_us - left.offset_us) / (right.timestamp_us - left.timestamp_us)


def _turns_up(first: Sample, second: Sample, third: Sample) -> bool:
    """Return whether the way from ``first`` over ``second`` to ``third`` bends upwards."""
    run_us, run_on_us = second.timestamp_us - first.timestamp_us, third.timestamp_us - first.timestamp_us
    return (second.offset_us - first.offset_us) * run_on_us < (third.offset_us - first.offset_us) * run_us
