"""A model of the server's clock, learned only from the frames' time stamps and arrival times.

A frame arrives at ``offset + (1 + drift) * time stamp + delay``, and its delay is never less than that of
an idle network. So only the frames with the least delay give information about the clocks. All others
show only that they were late.

1. Minimum filtering: the frame with the least delay in each window of half a second becomes a sample and is
   kept for 30 s. A mean of all frames would follow the jitter.
2. The clock is the line below all samples with the least sum of distances to them. This is the most likely
   line if delays are exponentially distributed. Its slope is that of the edge of the samples' lower convex
   hull that spans their mean time stamp (Zhang, Liu, Xia, "Clock synchronization algorithms for network
   measurements", INFOCOM 2002; earlier as a linear programme by Moon, Skelly, Towsley, INFOCOM 1999; for
   sensors by Olson, "A passive solution to the sensor synchronization problem", IROS 2010). Over less than
   5 s, drift cannot be distinguished from jitter; until then the drift keeps its last value.
3. A frame that arrives before the line disproves the line, so the line moves down to that frame at once. If
   the frame arrives far before the line, the server's clock was set, and all samples become invalid. The
   drift stays, because setting a clock does not change the rate of its crystal.
4. A late frame proves nothing: the cause can be a pause, congestion, or a clock that was set. Samples of
   windows in which every frame was late are kept apart. They replace the other samples once they have been
   equally late for two seconds, which rules out congestion that grows or clears, or late for 30 s.
5. If a time stamp or frame number goes back, the server has a new time base, and a new line starts at that
   frame. A time stamp that goes back by almost 2^32 µs has wrapped around, and the line continues (field
   note 11). Time stamps that do not change, or whose rate no crystal has, are not a clock.
6. A new connection may be to a server that has restarted, with any time stamps. It therefore begins a new
   line, too, and the former line is kept aside. The first frame that is neither early nor late by the former
   line proves that it still holds; a frame that is early disproves it.
7. A time stamp that means "no time" (field note 25) says nothing about the clock. Such a frame has the time
   of its arrival.

The least delay itself cannot be measured from one side: every time computed here includes it.

All times of the host are on its steady clock (``HostClock``), so setting the host's wall clock changes
nothing here.
"""

import math
from collections import deque
from collections.abc import Sequence
from itertools import islice, pairwise
from typing import Final, NamedTuple

MAX_DRIFT: Final = 500e-6
"""Crystals are within 100e-6 of their rate. With more drift than this, time stamps are not µs of a clock."""

_WINDOW_US: Final = 500_000
"""The length of a window. Even at 30 Hz it has 15 frames to choose from."""

_KEPT_WINDOWS: Final = 60
"""The number of samples, one per window. More are better for a constant drift, but worse for one that varies
with the room's temperature."""

_MIN_SAMPLES: Final = 3
"""A line always fits two samples. Only a third can contradict it."""

_DRIFT_SPAN_US: Final = 5_000_000
"""The drift is computed from this span on. In it, a drift of 100 ppm makes 0.5 ms, more than the least delays
of windows differ."""

_RATE_TOLERANCE_US: Final = 10_000
"""Least delays of windows may differ by this much, so over a short span the slope may exceed MAX_DRIFT."""

_STEP_US: Final = 2_000
"""A clock that was set by less is not detected; the error disappears as new samples replace the old ones."""

_STEP_WINDOWS: Final = 4
"""The number of windows that must be equally late to prove that a clock was set."""

_RESTART_US: Final = 1_000_000
"""Time stamps that continue differ by less from the former line, except for its drift. Delays of more than a
second are rare in a new connection, and would count a restart too many at worst."""

_ROUNDING_US: Final = 2.0  # time stamps and arrivals are whole µs
_FROZEN_US: Final = 500_000  # a time stamp that is repeated for longer is not that of a clock
_WRAP_US: Final = 1 << 32  # 32-bit time stamps start again at 0
_WRAP_TOLERANCE_US: Final = 1_000_000  # between the arrival times and the time stamps around a wrap
_NO_TIMESTAMP_US: Final = 1 << 63  # larger than any time stamp: those are signed 64-bit integers

_NO_TIMES_US: Final = (0, -1, -(1 << 63))
"""What servers send if they have no time: 0, all bits set, the smallest integer (field note 25)."""


class Sample(NamedTuple):
    """The frame with the least delay in its window: its time stamp, and its arrival time minus that."""

    timestamp_us: int
    offset_us: int


class FormerLine(NamedTuple):
    """What was known of the clock when the previous connection ended: its line and its samples."""

    timestamp_us: int
    host_us: int
    drift: float
    scatter_us: float
    samples: deque[Sample]

    def lag_us(self, server_us: int, arrival_us: int) -> int:
        """Return how late a frame is by this line; less than 0 disproves the line."""
        elapsed_us = server_us - self.timestamp_us
        return arrival_us - self.host_us - elapsed_us - int(self.drift * elapsed_us)


class ServerClock:
    """The clock of one server, learned from its frames as the module's docstring describes.

    While ``has_clock`` is False (in the first 1.5 s, and whenever time stamps are unusable),
    ``capture_us`` is the time of arrival. Within one time base, ``capture_us`` never decreases from
    frame to frame unless the arrival times do; it may stay equal.
    """

    def __init__(self) -> None:
        self.has_clock = False
        self._samples: deque[Sample] = deque(maxlen=_KEPT_WINDOWS)
        self._late_samples: deque[Sample] = deque(maxlen=_KEPT_WINDOWS)
        self._scatter_us = math.inf
        # The line: one time stamp, its host time, and the slope minus 1.
        self._line_timestamp_us = self._line_host_us = 0
        self._drift = 0.0
        # The previous frame.
        self._timestamp_us = _NO_TIMESTAMP_US
        self._frame_number = self._arrival_us = self._capture_us = 0
        # The total, in µs, that 32-bit time stamps have lost by wrapping around. Line and samples include it.
        self._wrapped_us = 0
        self._is_interrupted = False  # by a frame without a time; before it, there was a clock
        self._is_connection_new = False  # no frame of it with a time has arrived
        self._former: FormerLine | None = None  # while it is neither proven nor disproved
        self._former_end_us = 0  # when it is given up, on the host's clock
        # The time stamp that was repeated last, and when it first arrived.
        self._repeated_us = _NO_TIMESTAMP_US
        self._repeated_since_us = 0
        # The current window, and the frame with the least delay in it.
        self._window_end_us = 0
        self._least_lag_us: float = math.inf
        self._least_timestamp_us = self._least_offset_us = 0

    @property
    def offset_us(self) -> int:
        """Host time minus server time at the last frame, in µs; 0 without a clock."""
        if not self.has_clock:
            return 0
        elapsed_us = self._timestamp_us + self._wrapped_us - self._line_timestamp_us
        capture_us = self._line_host_us + elapsed_us + int(self._drift * elapsed_us)
        return capture_us - self._timestamp_us

    @property
    def drift_ppm(self) -> float:
        """How much faster the host's clock runs than the server's, in ppm; 0 without a clock."""
        return self._drift * 1e6 if self.has_clock else 0.0

    @property
    def uncertainty_us(self) -> float:
        """How much the least delays of the windows differ, in µs; errors rarely exceed it.

        It is inf without a clock and during the first three windows. It does not include the network's least
        delay, which all frames have in common.
        """
        return self._scatter_us if self.has_clock else math.inf

    @property
    def samples(self) -> int:
        """The number of samples that determine the line, at most 60."""
        return len(self._samples)

    def begin_connection(self) -> None:
        """Expect the first frame of a new connection, maybe to a server that has restarted."""
        self._is_connection_new = True

    def observe(self, timestamp_us: int, frame_number: int, arrival_us: int) -> tuple[int, float, bool]:
        """Learn from one frame; return its (capture_us, lag_s, restarted).

        Call it once per frame, in the order of arrival. ``arrival_us`` is in µs on the host's steady clock.
        ``timestamp_us`` and ``frame_number`` are those of one of the frame's components (§7.1). The frame
        numbers must be of one type of component, because servers may number each type separately, and a
        number that goes back is a restart.

        ``capture_us`` is when the frame was captured, on the same clock, never after its arrival.
        ``lag_s`` is how much later it arrived than a frame with the least delay would have; it is 0 without a
        clock. ``restarted`` is True if the server's time or frame numbers started again with this frame.

        After ``begin_connection``, ``restarted`` is also True if they went forward, but not as the former
        clock would have. Whatever they do, ``capture_us`` then comes from the time of arrival of the frames
        of this connection, or from the former line if they prove that it still holds.
        """
        restarted = False
        is_irregular = (
            timestamp_us <= self._timestamp_us or frame_number < self._frame_number or self._is_connection_new
        )
        if is_irregular and self._is_without_time(timestamp_us, frame_number):
            self._is_interrupted = self._is_interrupted or self.has_clock
            self.has_clock = False
            self._frame_number = frame_number
            self._capture_us = arrival_us
            return arrival_us, 0.0, False
        if self._is_interrupted:
            self._is_interrupted = False
            self.has_clock = True
        if is_irregular:
            restarted = self._handle_irregular(timestamp_us, frame_number, arrival_us)
        elif arrival_us >= self._window_end_us:
            self._close_window(arrival_us)
        self._timestamp_us = timestamp_us
        self._frame_number = frame_number
        self._arrival_us = arrival_us

        server_us = timestamp_us + self._wrapped_us
        elapsed_us = server_us - self._line_timestamp_us
        capture_us = self._line_host_us + elapsed_us + int(self._drift * elapsed_us)
        lag_us = arrival_us - capture_us
        if lag_us < self._least_lag_us:
            lag_us = self._learn_from(server_us, arrival_us, lag_us)
            capture_us = arrival_us - lag_us
        if not self.has_clock:
            self._capture_us = arrival_us
            return arrival_us, 0.0, restarted
        # A new line may be below the previous one. Subscribers must not see time go back because of that.
        if capture_us < self._capture_us:
            capture_us = min(self._capture_us, arrival_us)
        self._capture_us = capture_us
        return capture_us, lag_us * 1e-6, restarted

    def _learn_from(self, server_us: int, arrival_us: int, lag_us: int) -> int:
        """Learn from the frame with the least delay in its window so far; return its lag thereafter."""
        if self._former is not None:
            lag_us = self._compare_with_former(self._former, server_us, arrival_us, lag_us)
        if lag_us < 0:
            if lag_us < -_STEP_US:
                self._clear_samples(arrival_us)
            self._line_timestamp_us, self._line_host_us = server_us, arrival_us
            lag_us = 0
        self._least_lag_us = float(lag_us)
        self._least_timestamp_us, self._least_offset_us = server_us, arrival_us - server_us
        return lag_us

    def _is_without_time(self, timestamp_us: int, frame_number: int) -> bool:
        """Return whether a frame that does not follow the last has a time stamp that means "no time".

        After a restart, which frame numbers show, such a value may be a real time.
        """
        is_first = self._timestamp_us == _NO_TIMESTAMP_US
        return timestamp_us in _NO_TIMES_US and not is_first and frame_number >= self._frame_number

    def _handle_irregular(self, timestamp_us: int, frame_number: int, arrival_us: int) -> bool:
        """Handle the first frame, or one that does not follow the last; return whether it is a restart."""
        if self._is_connection_new:
            return self._handle_first_of_connection(timestamp_us, frame_number, arrival_us)
        if self._timestamp_us == _NO_TIMESTAMP_US:
            self._start(timestamp_us, arrival_us, has_clock=False)
            return False
        if frame_number >= self._frame_number:
            if timestamp_us == self._timestamp_us:
                # Duplicate frames and coarse time stamps still come from a clock; frozen ones do not.
                if timestamp_us != self._repeated_us:
                    self._repeated_us, self._repeated_since_us = timestamp_us, self._arrival_us
                if arrival_us - self._repeated_since_us > _FROZEN_US:
                    self._start(timestamp_us, arrival_us, has_clock=False)
                return False
            if self._has_wrapped(timestamp_us, arrival_us):
                self._wrapped_us += _WRAP_US
                return False
        self._start(timestamp_us, arrival_us, has_clock=self._probably_has_clock)
        return True

    def _handle_first_of_connection(self, timestamp_us: int, frame_number: int, arrival_us: int) -> bool:
        """Handle the first frame of a new connection; return whether the server has restarted."""
        self._is_connection_new = False
        if self._timestamp_us == _NO_TIMESTAMP_US:
            self._start(timestamp_us, arrival_us, has_clock=False)
            return False
        has_clock, wrapped_us, former = self._probably_has_clock, self._wrapped_us, self._former
        if has_clock:
            line = (self._line_timestamp_us, self._line_host_us, self._drift)
            former = FormerLine(*line, self._scatter_us, self._samples.copy())
        goes_back = timestamp_us < self._timestamp_us
        if goes_back and self._has_wrapped(timestamp_us, arrival_us):
            goes_back = False
            wrapped_us += _WRAP_US
        if goes_back:
            self._start(timestamp_us, arrival_us, has_clock=has_clock)
            return True
        self._start(timestamp_us, arrival_us, has_clock=has_clock, wrapped_us=wrapped_us)
        if former is None:
            return frame_number < self._frame_number
        self._former = former
        self._former_end_us = arrival_us + _KEPT_WINDOWS * _WINDOW_US
        # Some servers number the frames of each connection, so here only the time decides.
        lag_us = former.lag_us(timestamp_us + wrapped_us, arrival_us)
        return abs(lag_us) > _RESTART_US + MAX_DRIFT * (arrival_us - self._arrival_us)

    def _compare_with_former(self, former: FormerLine, server_us: int, arrival_us: int, lag_us: int) -> int:
        """Continue the former line if this frame proves it; forget it if it is disproved or too old.

        ``lag_us`` is the frame's lag by the present line. Return its lag by the line that holds.
        """
        former_lag_us = former.lag_us(server_us, arrival_us)
        scatter_us = former.scatter_us if former.scatter_us < math.inf else 0.0
        if -_STEP_US <= former_lag_us <= _STEP_US + scatter_us:
            self._clear_samples(arrival_us)
            self.has_clock = True
            self._line_timestamp_us, self._line_host_us = former.timestamp_us, former.host_us
            self._drift, self._scatter_us, self._samples = former.drift, former.scatter_us, former.samples
            self._former = None
            return former_lag_us
        if former_lag_us < 0 or arrival_us > self._former_end_us:
            self._former = None
        return lag_us

    @property
    def _probably_has_clock(self) -> bool:
        """Whether a server that had a clock still has one: unless it restarts in its first window."""
        return self.has_clock and len(self._samples) > 0

    def _has_wrapped(self, timestamp_us: int, arrival_us: int) -> bool:
        """Return whether a time stamp that goes back has wrapped around."""
        advance_us = timestamp_us + _WRAP_US - self._timestamp_us
        elapsed_us = arrival_us - self._arrival_us
        return advance_us > 0 and abs(advance_us - elapsed_us) < _WRAP_TOLERANCE_US

    def _start(self, timestamp_us: int, arrival_us: int, *, has_clock: bool, wrapped_us: int = 0) -> None:
        """Start a new line through this frame."""
        self.has_clock = has_clock
        self._wrapped_us = wrapped_us
        self._former = None
        self._line_timestamp_us, self._line_host_us = timestamp_us + wrapped_us, arrival_us
        self._clear_samples(arrival_us)

    def _clear_samples(self, arrival_us: int) -> None:
        self._samples.clear()
        self._late_samples.clear()
        self._scatter_us = math.inf
        self._window_end_us = arrival_us + _WINDOW_US
        self._least_lag_us = math.inf

    def _close_window(self, arrival_us: int) -> None:
        """End the current window: add its sample to the others or to the late ones, and fit the line."""
        lag_us = self._least_lag_us
        least = Sample(self._least_timestamp_us, self._least_offset_us)
        self._window_end_us = arrival_us + _WINDOW_US
        self._least_lag_us = math.inf
        late_us = _STEP_US + 4 * self._scatter_us
        if lag_us < late_us:
            self._samples.append(least)
        else:
            late = self._late_samples
            late.append(least)
            # Whether a clock was set: point 4 of the module's docstring.
            newest = islice(reversed(late), _STEP_WINDOWS)
            spread_us = max(sample.offset_us for sample in newest) - min(sample.offset_us for sample in late)
            is_stable = len(late) >= _STEP_WINDOWS and spread_us < min(lag_us / 4, late_us)
            if not is_stable and len(late) < _KEPT_WINDOWS:
                return
            self._samples = late.copy()
        self._late_samples.clear()
        self._fit_line()

    def _fit_line(self) -> None:
        """Fit the line to the samples, and check whether its slope can be that of a clock."""
        samples = self._samples
        last = samples[-1]
        span_us = last.timestamp_us - samples[0].timestamp_us
        enough = len(samples) >= _MIN_SAMPLES
        if enough:
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
        self._line_host_us = last.timestamp_us + last.offset_us + math.floor(least_us)
        if enough:
            # The line touches two of the samples by construction, so they do not count.
            scatter_us = sum(height_us - least_us for height_us in heights_us) / (len(samples) - 2)
            self._scatter_us = max(scatter_us, _ROUNDING_US)


def envelope_slope(samples: Sequence[Sample]) -> float:
    """Return the slope of the line below all samples with the least sum of distances to them.

    ``samples`` are at least two, with strictly increasing time stamps. The line is the edge of their lower
    convex hull that spans their mean time stamp.
    """
    hull: list[Sample] = []
    for sample in samples:
        while len(hull) > 1:
            (first_us, first_offset_us), (second_us, second_offset_us) = hull[-2:]
            rise_us, rise_on_us = second_offset_us - first_offset_us, sample.offset_us - first_offset_us
            if rise_us * (sample.timestamp_us - first_us) < rise_on_us * (second_us - first_us):
                break  # the path over the three turns up
            hull.pop()
        hull.append(sample)
    # Without a division, because a float may be larger than all time stamps that it is the mean of.
    total_us = sum(sample.timestamp_us for sample in samples)
    left, right = next(edge for edge in pairwise(hull) if edge[1].timestamp_us * len(samples) >= total_us)
    return (right.offset_us - left.offset_us) / (right.timestamp_us - left.timestamp_us)
