"""Placing the frames of a measurement on a regular grid, by the server's time stamps.

C3D and TRC have a rate and no times. A frame that is missing becomes a row without values, so that all others
keep their places. The times of capture are not used: their jitter would bend the grid.
"""

from typing import Final, NamedTuple

import numpy as np

from gateway.takes.component_rows import Array
from gateway.takes.series import Series, regular_step

MAX_GAP_S: Final = 10.0
"""After a longer gap, a new grid begins."""

_TOLERANCE: Final = 0.02
"""How much the measured rate may differ from the announced one, as a part of it, to be the same rate."""


class Grid(NamedTuple):
    """Where frames of a series belong: ``rows`` has the row of each of ``frames``, which are indices.

    Both have the shape (frames,) and are in order of time; no row occurs twice. ``times_us`` are the server's
    time stamps of these frames (``has_time_stamps``), or their times of capture if the server sends none.
    """

    rate_hz: float
    rows: Array
    frames: Array
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
    order = np.argsort(run.sequence, kind="stable")
    order = order[np.concatenate([[True], np.diff(run.sequence[order]) > 0])]
    sequence = run.sequence[order]
    stamps = run.timestamp_us[order]
    has_time_stamps = by_time_stamps and _progresses(stamps)
    times = stamps if has_time_stamps else run.capture_utime[order]
    period_us = regular_step(np.diff(times)[np.diff(sequence) == 1])
    rate_hz = _rate_hz(period_us, run.rate_hz)
    if has_time_stamps and period_us:
        distances = np.diff(times) / period_us
        steps = np.maximum(np.round(np.minimum(distances, 1e15)), 1).astype(np.int64)
    else:
        steps = np.diff(sequence)
    cuts = np.flatnonzero(steps > MAX_GAP_S * rate_hz) + 1
    rows = np.concatenate([[0], np.cumsum(np.where(steps > MAX_GAP_S * rate_hz, 1, steps))])
    return [
        Grid(rate_hz, rows[start:stop] - rows[start], order[start:stop], times[start:stop], has_time_stamps)
        for start, stop in zip([0, *cuts.tolist()], [*cuts.tolist(), len(order)], strict=True)
    ]


def _progresses(stamps: Array) -> bool:
    return len(stamps) == 1 or bool((np.diff(stamps) > 0).mean() > 0.5)


def _rate_hz(period_us: float | None, announced_hz: float | None) -> float:
    """Return the announced rate, or the part of it that was recorded, or else the measured rate."""
    if period_us is None:
        return announced_hz or 1.0
    measured_hz = 1e6 / period_us
    if announced_hz:
        divisor = max(1, round(announced_hz / measured_hz))
        if abs(announced_hz / divisor - measured_hz) <= _TOLERANCE * measured_hz:
            return announced_hz / divisor
    rounded_hz = round(measured_hz)
    return float(rounded_hz) if abs(rounded_hz - measured_hz) <= 0.001 * measured_hz else measured_hz
