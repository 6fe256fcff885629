"""The zero of time in exported files: the beginning of the take, which is the time of its first message.

``open_take``, the columns ``time_s`` of CSV and ``Time`` of TRC, and --from and --to count from it. MCAP has
times since 1970. A C3D file can only count from its first frame; it says how much later that is.
"""

from datetime import UTC, datetime, timedelta
from typing import Final

import numpy as np

from gateway.takes.export.measurements import Measurement

_AVERAGED_S: Final = 1.0
"""The frames of this duration decide when the first one was, because times of capture have a jitter."""

_CLOCK_STEP_S: Final = 0.2
"""Frames whose times differ more than this from that of the first one come after a step of the clock."""

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


def seconds_of_row(measurement: Measurement, row: int) -> float:
    """Return when a row of a measurement was captured, in seconds since the beginning of the take."""
    base, grid = measurement.base, measurement.grid
    is_first = grid.rows < max(_AVERAGED_S * grid.rate_hz, 1)
    starts_s = base.seconds[grid.frames[is_first]] - grid.rows[is_first] / grid.rate_hz
    same_clock = abs(starts_s - starts_s[0]) <= _CLOCK_STEP_S
    return float(np.median(starts_s[same_clock])) + row / grid.rate_hz


def utc_text(measurement: Measurement, seconds: float = 0.0) -> str:
    """Return a time of the take as in 2026-11-22T14:49:19.731938Z."""
    utime = measurement.base.start_utime + round(seconds * 1e6)
    try:
        time = _EPOCH + timedelta(microseconds=utime)
    except OverflowError:
        return f"{utime} microseconds since 1970"
    return time.isoformat(timespec="microseconds").replace("+00:00", "Z")
