"""An array that grows in place, without a second copy of its content in memory."""

from typing import Any, Final

import numpy as np

from gateway.takes.component_rows import Array

_GROWTH: Final = 1.125
"""How much more room each enlargement makes: what is not filled takes memory, too."""


class GrowingArray:
    """Rows of a fixed shape. The system enlarges large arrays by moving their pages, not their content."""

    def __init__(self, dtype: np.dtype[Any], row_shape: tuple[int, ...] = ()) -> None:
        self._rows: Array = np.empty((0, *row_shape), dtype)
        self._num_rows = 0

    def extend(self, rows: Array) -> None:
        """Append rows; they are converted to the dtype."""
        stop = self._num_rows + len(rows)
        if stop > len(self._rows):
            self._resize(max(stop, int(len(self._rows) * _GROWTH)))
        self._rows[self._num_rows : stop] = rows
        self._num_rows = stop

    def take(self) -> Array:
        """Return the rows, and forget them."""
        self._resize(self._num_rows)
        rows, self._rows, self._num_rows = self._rows, self._rows[:0].copy(), 0
        return rows

    def _resize(self, num_rows: int) -> None:
        # Nothing else refers to the array, and it is not used while it is resized.
        self._rows.resize((num_rows, *self._rows.shape[1:]), refcheck=False)
