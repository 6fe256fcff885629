"""The smallest and the largest value of a channel per column of a plot, over the last seconds."""

from typing import Final

import numpy as np

from gateway.takes.component_rows import Array

NUM_COLUMNS: Final = 320
COLUMN_US: Final = 31_250
"""320 columns of 31.25 ms are 10 s."""

_MAX_STEP_COLUMNS: Final = 32
"""If times go back, or forward, by more than a second, the envelope starts again there.

A plot would connect the values before and after a gap, as if there had been some between them.
"""


class Envelope:
    """The smallest and the largest value of a channel in each column of a plot.

    Every sample of the last NUM_COLUMNS columns, and since the last gap, is within them. Values that are not
    finite are missing. Times are µs since the Unix epoch.
    """

    def __init__(self) -> None:
        self._lowest = np.full(NUM_COLUMNS, np.nan)
        self._highest = np.full(NUM_COLUMNS, np.nan)
        self._newest: int | None = None  # the newest column, counted from the epoch

    @property
    def newest_utime(self) -> int | None:
        """The begin of the newest column; None before the first sample."""
        return None if self._newest is None else self._newest * COLUMN_US

    def add(self, utimes: Array, values: Array) -> None:
        """Take samples, two arrays of shape (samples,), nearly in the order of their times."""
        if not len(utimes):
            return
        columns = utimes.astype(np.int64) // COLUMN_US
        values = values.astype(np.float64)
        values[~np.isfinite(values)] = np.nan
        # One step for each run of samples in the same column.
        begins = np.concatenate([[0], 1 + np.flatnonzero(np.diff(columns))])
        lowest, highest = np.fmin.reduceat(values, begins), np.fmax.reduceat(values, begins)
        for column, low, high in zip(columns[begins].tolist(), lowest, highest, strict=True):
            self._make_room(column)
            place = column % NUM_COLUMNS
            self._lowest[place] = np.fmin(self._lowest[place], low)
            self._highest[place] = np.fmax(self._highest[place], high)

    def columns(self, end_utime: int) -> tuple[Array, Array]:
        """Return the smallest and the largest values, oldest first, each of shape (NUM_COLUMNS,).

        The last column is that of ``end_utime``. Columns without a sample are NaN.
        """
        newest = self._newest
        if newest is None:
            return self._lowest.copy(), self._highest.copy()
        wanted = end_utime // COLUMN_US + np.arange(1 - NUM_COLUMNS, 1)
        is_kept = (wanted <= newest) & (wanted > newest - NUM_COLUMNS)
        places = wanted % NUM_COLUMNS
        lowest, highest = self._lowest[places], self._highest[places]
        return np.where(is_kept, lowest, np.nan), np.where(is_kept, highest, np.nan)

    def _make_room(self, column: int) -> None:
        newest = self._newest
        if newest is None or abs(column - newest) > _MAX_STEP_COLUMNS:
            self._clear(slice(None))
            self._newest = column
        elif column > newest:
            self._clear(np.arange(newest + 1, column + 1) % NUM_COLUMNS)
            self._newest = column

    def _clear(self, places: slice | Array) -> None:
        self._lowest[places] = np.nan
        self._highest[places] = np.nan
