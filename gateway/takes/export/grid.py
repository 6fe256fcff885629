"""The grid of a run: which row each frame belongs to, in formats that have a rate and no times.

A frame that is missing becomes a row without values, so that all others keep their places. The times of
capture are not used: their jitter would bend the grid.
"""

from itertools import pairwise
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from gateway.takes.export.period import RunTimes, measured_period_us, number_step, rate_changes
from gateway.takes.export.row_shifts import MAX_INT32, is_near, line_period_us, numbered_rows, shifts_of
from gateway.takes.files.component_rows import NO_TIMES_US, Array
from gateway.takes.files.series import Series
from gateway.takes.files.spool import pieces

MAX_GAP_S: Final = 10.0
"""After a longer gap, a new grid begins."""

_TOLERANCE: Final = 0.005
"""How much the measured rate may differ from the announced one, as a part of it, to be the same rate.

For half of the announced rate it is half as much, and so on."""

_MAX_TOLERANCE: Final = 0.02

Frames: TypeAlias = Array | slice
"""Indices of frames: of a recording without gaps, a slice, which takes no memory."""


class Grid(NamedTuple):
    """Where frames of a series belong: ``rows`` has the row of each of ``frames``, which are indices.

    Both are in order of time; no row occurs twice. ``times_us`` are the server's time stamps of these frames
    (``has_time_stamps``), or their times of capture if the server sends none. ``rate_hz`` is the rate that
    files have, and ``measured_hz`` that of the time stamps; without time stamps, both are the same.
    ``skipped_rows`` are those without a frame although the numbers of the frames go on: the time stamps jump
    there. ``num_repeated`` is how many frames were left out, because they have the time stamp and the number
    of the frame before them.
    """

    rate_hz: float
    measured_hz: float
    rows: Array
    frames: Frames
    times_us: Array
    has_time_stamps: bool
    skipped_rows: Array
    num_repeated: int = 0

    @property
    def num_rows(self) -> int:
        """The number of rows from the first frame to the last."""
        return int(self.rows[-1]) + 1

    def largest_error_us(self) -> float:
        """Return how far the time stamp of a frame is from the time of its row at most."""
        if not self.has_time_stamps:
            return 0.0
        period_us = 1e6 / self.rate_hz
        offset_us: float | None = None
        largest = 0.0
        for start, stop in pieces(len(self.rows)):
            errors = (self.times_us[start:stop] - self.times_us[0]) - self.rows[start:stop] * period_us
            if offset_us is None:  # as `seconds_of_row` does with the times of capture
                offset_us = float(np.median(errors[: max(round(self.rate_hz), 1)]))
            largest = max(largest, float(abs(errors - offset_us).max()))
        return largest


def place(run: Series, *, by_time_stamps: bool = True) -> list[Grid]:
    """Return the places of a run's frames, in several grids if there are gaps of more than 10 s.

    The row of a frame is what its number says, as long as the time stamps agree; otherwise, it is the time
    since the first one, divided by the period and rounded: no error adds up. The period is that of the time
    stamps, so a server's clock that is a little fast or slow leaves no rows empty. If the time stamps do not
    progress (field note 25), or are not to be used, the sequence numbers place the frames.
    Frames that come faster than the rate for a while have a grid of their own.
    """
    order = _by_sequence(run.sequence)
    frames: Frames = slice(0, len(run)) if order is None else order
    sequence = run.sequence[frames]
    num_repeated = 0
    has_time_stamps = by_time_stamps
    if by_time_stamps:
        is_new = _is_new(run.timestamp_us[frames], run.frame_number[frames])
        if is_new is not None:
            num_repeated = len(is_new) - int(is_new.sum())
            sequence = _without_repeated(sequence, is_new)
            frames = np.flatnonzero(is_new) if order is None else order[is_new]
        has_time_stamps = _mostly_progresses(run.timestamp_us[frames])
    times = run.timestamp_us[frames] if has_time_stamps else run.capture_utime[frames]
    numbers = run.frame_number[frames]
    whole = RunTimes(sequence, numbers, times, number_step(numbers))
    grids, is_dense = _grids(whole, frames, run.rate_hz, has_time_stamps=has_time_stamps)
    changes = rate_changes(whole) if is_dense else []
    if changes:
        parts = pairwise([0, *changes, len(whole)])
        grids = [
            grid
            for start, stop in parts
            for grid in _grids(
                whole.part(start, stop),
                some_frames(frames, start, stop),
                run.rate_hz,
                has_time_stamps=has_time_stamps,
            )[0]
        ]
    grids[0] = grids[0]._replace(num_repeated=num_repeated)
    return grids


def some_frames(frames: Frames, start: int, stop: int) -> Frames:
    """Return some of the frames: those at these places."""
    return (
        slice(frames.start + start, frames.start + stop) if isinstance(frames, slice) else frames[start:stop]
    )


def _grids(
    run: RunTimes, frames: Frames, announced_hz: float | None, *, has_time_stamps: bool
) -> tuple[list[Grid], bool]:
    """Return the grids of frames, and whether there are more frames than rows in one of them."""
    period_us = _period_us(run)
    rate_hz = _rate_hz(period_us, announced_hz, len(run))
    measured_hz = 1e6 / period_us if period_us and has_time_stamps else rate_hz
    max_gap = MAX_GAP_S * rate_hz
    uses_times_us = period_us if has_time_stamps else None
    grids: list[Grid] = []
    is_any_dense = False
    for start, stop in pairwise([0, *_cuts(run, uses_times_us, max_gap), len(run)]):
        part = run.part(start, stop)
        rows, is_dense = _rows(part, uses_times_us)
        is_any_dense |= is_dense
        skipped = _skipped_rows(part, rows)
        chosen = some_frames(frames, start, stop)
        grids.append(Grid(rate_hz, measured_hz, rows, chosen, part.times_us, has_time_stamps, skipped))
    return grids, is_any_dense


def _period_us(run: RunTimes) -> float | None:
    """Return the time from one row to the next; None if it is not known.

    If the time stamps agree with the numbers, it is that of the line through all frames. Otherwise, there are
    gaps that the numbers do not show, or the rate changes, and the period is measured in blocks.
    """
    rows = numbered_rows(run, RunTimes.counted)
    period_us = line_period_us(run, rows)
    if period_us is not None and is_near(shifts_of(run, rows, period_us)):
        return period_us
    return measured_period_us(run)


def _cuts(run: RunTimes, period_us: float | None, max_gap: float) -> list[int]:
    """Return the frames but the first with which a grid begins."""
    cuts: list[int] = []
    for start, stop in pieces(len(run)):
        near = run.part(max(start - 1, 0), stop)
        steps = np.diff(near.sequence) if period_us is None else np.round(np.diff(near.times_us) / period_us)
        cuts += (np.flatnonzero(steps > max_gap) + max(start, 1)).tolist()
    return cuts


def _rows(run: RunTimes, period_us: float | None) -> tuple[Array, bool]:
    """Return the rows of frames, and whether the frames come faster than rows.

    If the time stamps agree with the numbers, these say the rows. Otherwise, each frame is moved by what the
    time stamps say: the middle between the largest shift before it and the smallest one after it, so that
    the rows increase.
    """
    if period_us is None:
        return numbered_rows(run, lambda near: np.diff(near.sequence)), False
    rows = numbered_rows(run, RunTimes.counted)
    if is_near(shifts_of(run, rows, period_us)):
        return rows, False
    rows = numbered_rows(run, lambda near: near.steps(period_us))
    shifts = shifts_of(run, rows, period_us)
    if is_near(shifts):
        return rows, False
    usual = np.median(shifts[:: 1 + len(shifts) // _MOST_COMPARED])
    largest_before = np.maximum.accumulate(shifts)
    shifts[::-1] = np.minimum.accumulate(shifts[::-1])
    is_dense = bool((largest_before - shifts).max() > 1.0)
    shifts += largest_before
    shifts /= 2
    rows = rows.astype(np.int64) + np.round(shifts - usual).astype(np.int64)
    rows -= rows[0]
    return rows if rows[-1] > MAX_INT32 else rows.astype(np.int32), is_dense


_MOST_COMPARED: Final = 10_000


def _skipped_rows(run: RunTimes, rows: Array) -> Array:
    """Return the rows without a frame that the numbers of the frames do not explain."""
    found = []
    for start, stop in pieces(len(run)):
        first = max(start - 1, 0)
        steps = np.diff(rows[first:stop])
        (places,) = np.nonzero(steps > 1)
        if not len(places):
            continue
        counted = np.minimum(run.part(first, stop).counted()[places], steps[places])
        found += [
            np.arange(row - number, row)
            for row, number in zip(
                rows[first + places + 1].tolist(), (steps[places] - counted).tolist(), strict=True
            )
        ]
    return np.concatenate(found) if found else np.empty(0, np.int64)


def _is_new(stamps: Array, numbers: Array) -> Array | None:
    """Return which frames do not repeat the one before them; None if none does, or if all are the same."""
    is_new = np.full(len(stamps), True)
    for start, stop in pieces(len(stamps)):
        near = slice(max(start - 1, 0), stop)
        is_same = (np.diff(stamps[near]) == 0) & (np.diff(numbers[near]) == 0)
        is_new[max(start, 1) : stop] = ~is_same | np.isin(stamps[max(start, 1) : stop], NO_TIMES_US)
    return is_new if 1 < is_new.sum() < len(is_new) else None


def _without_repeated(sequence: Array, is_new: Array) -> Array:
    """Return the gateway's numbers of the new frames as if it had not counted those that repeat them.

    Otherwise, the places of the repeated ones would be empty rows.
    """
    numbers = sequence[is_new]
    steps = np.diff(numbers)
    copies = number_step(numbers)
    if copies > 1 and np.count_nonzero(steps % copies) <= _FEW * len(steps):
        counted = np.round(steps / copies).astype(np.int64).clip(1)  # of lost frames, all copies are missing
        return np.concatenate([[0], np.cumsum(counted)])
    found: Array = (sequence - np.cumsum(~is_new))[is_new]
    return found


_FEW: Final = 0.2


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


def _rate_hz(period_us: float | None, announced_hz: float | None, num_frames: int) -> float:
    """Return the announced rate, or the part of it that was recorded, or else the measured rate."""
    if period_us is None:
        return announced_hz or 1.0
    measured_hz = 1e6 / period_us
    # A few frames with a jitter say little about the rate.
    tolerance = max(_TOLERANCE, min(_MAX_TOLERANCE, 0.5 / num_frames))
    if announced_hz:
        divisor = max(1, round(announced_hz / measured_hz))
        # A high rate has parts near any other, such as 1000/33 Hz near 30 Hz.
        if abs(announced_hz / divisor - measured_hz) <= tolerance / divisor * measured_hz:
            return announced_hz / divisor
    rounded_hz = round(measured_hz)
    return float(rounded_hz) if abs(rounded_hz - measured_hz) <= 0.001 * measured_hz else measured_hz


def bounds(rows: Array, start: int, stop: int) -> tuple[int, int]:
    """Return where the rows from ``start`` on begin, and where those before ``stop`` end. Rows increase."""
    limits = np.minimum([start, stop], np.iinfo(rows.dtype).max).astype(rows.dtype)
    first, last = np.searchsorted(rows, limits).tolist()  # limits of another type would have all rows copied
    return first, last
