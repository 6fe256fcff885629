"""The grid of a run: which row each frame belongs to, in formats that have a rate and no times.

A frame that is missing becomes a row without values, so that all others keep their places. The times of
capture are not used: their jitter would bend the grid.
"""

from typing import Final, NamedTuple, TypeAlias

import numpy as np

from gateway.takes.files.component_rows import Array
from gateway.takes.files.series import Series, regular_step
from gateway.takes.files.spool import pieces

MAX_GAP_S: Final = 10.0
"""After a longer gap, a new grid begins."""

_TOLERANCE: Final = 0.02
"""How much the measured rate may differ from the announced one, as a part of it, to be the same rate.

For half of the announced rate it is half as much, and so on."""


Frames: TypeAlias = Array | slice
"""Indices of frames: of a recording without gaps, a slice, which takes no memory."""


class Grid(NamedTuple):
    """Where frames of a series belong: ``rows`` has the row of each of ``frames``, which are indices.

    Both are in order of time; no row occurs twice. ``times_us`` are the server's time stamps of these frames
    (``has_time_stamps``), or their times of capture if the server sends none. ``rate_hz`` is the rate that
    files have, and ``measured_hz`` that of the time stamps; without time stamps, both are the same.
    """

    rate_hz: float
    measured_hz: float
    rows: Array
    frames: Frames
    times_us: Array
    has_time_stamps: bool

    @property
    def num_rows(self) -> int:
        """The number of rows from the first frame to the last."""
        return int(self.rows[-1]) + 1


def place(run: Series, *, by_time_stamps: bool = True) -> list[Grid]:
    """Return the places of a run's frames, in several grids if there are gaps of more than 10 s.

    The distance of two frames is the difference of their time stamps, divided by the period and rounded to at
    least 1. Thus a server's clock that is a little fast or slow does no harm. If the time stamps do not
    progress (field note 25), or are not to be used, it is the difference of the sequence numbers.
    """
    order = _by_sequence(run.sequence)
    sequence, stamps, captures = run.sequence, run.timestamp_us, run.capture_utime
    if order is not None:
        sequence, stamps, captures = sequence[order], stamps[order], captures[order]
    has_time_stamps = by_time_stamps and _mostly_progresses(stamps)
    times = stamps if has_time_stamps else captures
    period_us = _period_us(times, sequence)
    rate_hz = _rate_hz(period_us, run.rate_hz)
    measured_hz = 1e6 / period_us if period_us and has_time_stamps else rate_hz
    max_gap = MAX_GAP_S * rate_hz
    rows = np.zeros(len(times), np.int32)
    cuts: list[int] = []
    newest = 0
    for start, stop in pieces(len(times)):
        near = slice(max(start - 1, 0), stop)
        if has_time_stamps and period_us:
            distances = np.diff(times[near]) / period_us
            steps = np.maximum(np.round(np.minimum(distances, 1e15)), 1).astype(np.int64)
        else:
            steps = np.diff(sequence[near])
        is_cut = steps > max_gap
        first = near.start + 1
        cuts += (np.flatnonzero(is_cut) + first).tolist()
        found = newest + np.cumsum(np.where(is_cut, 1, steps), dtype=np.int64)
        newest = int(found[-1]) if len(found) else newest
        if newest > _MAX_INT32:
            rows = rows.astype(np.int64)
        rows[first:stop] = found
    frames = slice(0, len(times)) if order is None else order
    grids = []
    for start, stop in zip([0, *cuts], [*cuts, len(times)], strict=True):
        rows[start:stop] -= rows[start]
        chosen = some_frames(frames, start, stop)
        grids.append(Grid(rate_hz, measured_hz, rows[start:stop], chosen, times[start:stop], has_time_stamps))
    return grids


def some_frames(frames: Frames, start: int, stop: int) -> Frames:
    """Return some of the frames: those at these places."""
    return (
        slice(frames.start + start, frames.start + stop) if isinstance(frames, slice) else frames[start:stop]
    )


def _by_sequence(sequence: Array) -> Array | None:
    """Return the indices of frames in the order of their numbers, each number once; None if they are so."""
    if all((np.diff(sequence[max(start - 1, 0) : stop]) > 0).all() for start, stop in pieces(len(sequence))):
        return None
    order: Array = np.argsort(sequence, kind="stable")
    is_new: Array = np.concatenate([[True], np.diff(sequence[order]) > 0])
    return order[is_new]


def _mostly_progresses(stamps: Array) -> bool:
    """Return whether more than half of the time stamps are larger than the one before."""
    num_larger = sum(
        int((np.diff(stamps[max(start - 1, 0) : stop]) > 0).sum()) for start, stop in pieces(len(stamps))
    )
    return len(stamps) == 1 or num_larger > 0.5 * (len(stamps) - 1)


def _period_us(times: Array, sequence: Array) -> float | None:
    """Return the mean time between neighbouring frames; None if it is not known."""
    means, counts = [], []
    for start, stop in pieces(len(times)):
        near = slice(max(start - 1, 0), stop)
        steps = np.diff(times[near])[np.diff(sequence[near]) == 1]
        mean = regular_step(steps)
        if mean is not None:
            means.append(mean)
            counts.append(len(steps))
    return float(np.average(means, weights=counts)) if means else None


def _rate_hz(period_us: float | None, announced_hz: float | None) -> float:
    """Return the announced rate, or the part of it that was recorded, or else the measured rate."""
    if period_us is None:
        return announced_hz or 1.0
    measured_hz = 1e6 / period_us
    if announced_hz:
        divisor = max(1, round(announced_hz / measured_hz))
        # A high rate has parts near any other, such as 1000/33 Hz near 30 Hz.
        if abs(announced_hz / divisor - measured_hz) <= _TOLERANCE / divisor * measured_hz:
            return announced_hz / divisor
    rounded_hz = round(measured_hz)
    return float(rounded_hz) if abs(rounded_hz - measured_hz) <= 0.001 * measured_hz else measured_hz


_MAX_INT32: Final = (1 << 31) - 1


def bounds(rows: Array, start: int, stop: int) -> tuple[int, int]:
    """Return where the rows from ``start`` on begin, and where those before ``stop`` end. Rows increase."""
    limits = np.minimum([start, stop], np.iinfo(rows.dtype).max).astype(rows.dtype)
    first, last = np.searchsorted(rows, limits).tolist()  # limits of another type would have all rows copied
    return first, last
