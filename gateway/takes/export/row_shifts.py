"""Rows that follow from the numbers of frames, and how far their time stamps are from these rows."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from gateway.takes.export.period import RunTimes
from gateway.takes.files.component_rows import Array
from gateway.takes.files.spool import pieces

_WINDOW: Final = 9
"""The median of so many frames says where they belong: single ones that are late or early have no effect."""

MAX_SPREAD: Final = 0.75
"""Time stamps that differ by no more rows than this from where the numbers place the frames leave them
there."""

MAX_INT32: Final = (1 << 31) - 1


def numbered_rows(run: RunTimes, steps_of: Callable[[RunTimes], Array]) -> Array:
    """Return the row of each frame, by the steps from one to the next that ``steps_of`` returns."""
    rows: Array = np.zeros(len(run), np.int32)
    newest = 0
    for start, stop in pieces(len(run)):
        first = max(start, 1)
        found = newest + np.cumsum(steps_of(run.part(first - 1, stop)), dtype=np.int64)
        newest = int(found[-1]) if len(found) else newest
        if newest > MAX_INT32:
            rows = rows.astype(np.int64)
        rows[first:stop] = found
    return rows


def line_period_us(run: RunTimes, rows: Array) -> float | None:
    """Return the slope of the line through the times of all frames in their rows; None if it does not rise.

    Jitter and single frames that are late have no effect on it, however many rows are missing.
    """
    squares = products = sum_rows = sum_times = 0.0
    for start, stop in pieces(len(run)):
        row = rows[start:stop].astype(np.float64)
        time = (run.times_us[start:stop] - run.times_us[0]).astype(np.float64)
        squares, products = squares + float(row @ row), products + float(row @ time)
        sum_rows, sum_times = sum_rows + float(row.sum()), sum_times + float(time.sum())
    squares -= sum_rows * sum_rows / len(run)
    products -= sum_rows * sum_times / len(run)
    return products / squares if squares > 0 and products > 0 else None


def shifts_of(run: RunTimes, rows: Array, period_us: float) -> Array:
    """Return how many rows later each frame was captured than its row, beside the first one.

    If these differ by more than MAX_SPREAD, the result is the median of each frame and its neighbours.
    """
    shifts = np.zeros(len(run), np.float32)
    for start, stop in pieces(len(run)):
        shifts[start:stop] = (run.times_us[start:stop] - run.times_us[0]) / period_us - rows[start:stop]
    return _smoothed(shifts) if np.ptp(shifts) > MAX_SPREAD else shifts


def is_near(shifts: Array) -> bool:
    """Whether the time stamps are as near to the rows as jitter leaves them."""
    return bool(np.ptp(shifts) <= MAX_SPREAD)


def _smoothed(shifts: Array) -> Array:
    """Return the median of each shift and its neighbours, as many before as after it, and two at least."""
    side = _WINDOW // 2
    result = shifts.copy()
    for start, stop in pieces(max(len(shifts) - 2 * side, 0)):
        near = shifts[start : stop + 2 * side]
        result[start + side : stop + side] = np.median(sliding_window_view(near, _WINDOW), axis=1)
    for place in range(min(side, len(shifts) // 2)):
        width = max(2 * place + 1, 3)
        result[place] = np.median(shifts[:width])
        result[-1 - place] = np.median(shifts[-width:])
    return result
