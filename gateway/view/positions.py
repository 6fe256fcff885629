"""Positions of markers and tools as they are shown."""

from typing import Final

import numpy as np

from gateway.messages.tool_pose import metres_per_unit
from gateway.takes.component_rows import Array

MAX_M: Final = 1000.0
"""Positions farther from the origin are not shown: no laboratory is that large."""


def positions_in_metres(items: Array, unit: str) -> Array:
    """Return the positions of markers or tools in metres, shape (items, 3), as float32.

    All three coordinates are NaN if one of them is missing or beyond MAX_M. An unknown unit counts as mm.
    """
    positions = np.stack([items["x"], items["y"], items["z"]], axis=-1).astype(np.float64)
    positions *= metres_per_unit(unit) or 1e-3
    positions[~(abs(positions) <= MAX_M).all(axis=1)] = np.nan
    return positions.astype(np.float32)


def is_shown(positions: Array) -> Array:
    """Return for each position whether it is shown, shape (items,): NaN is not."""
    shown: Array = ~np.isnan(positions[:, 0])
    return shown
