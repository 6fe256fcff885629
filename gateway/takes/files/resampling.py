"""A series at another rate, on a grid of times that all components share."""

import math
from typing import Final, TypeVar

import numpy as np

from gateway.errors import TakeError
from gateway.rtc3d.components import MISSING, ComponentType
from gateway.takes.files.component_rows import HEAD, NATIVE_ITEM_DTYPES, Array
from gateway.takes.files.series_data import (
    MAX_PADDING,
    MIN_LIMIT_BYTES,
    SeriesContent,
    SeriesData,
    regular_step,
)

_MAX_RATE_HZ: Final = 1_000_000
"""Times are in whole µs."""

_BLOCK_ROWS: Final = 20_000
"""How many rows are computed at a time, in 64 bits."""

_NEIGHBOURS: Final = 1.5
"""Frames no further apart than this many periods are neighbours, with none missing between them."""

_NUM_VALUES: Final = {
    ComponentType.MARKERS: 3,
    ComponentType.TOOLS: 7,
    ComponentType.ANALOG: 1,
    ComponentType.FORCE: 6,
}
"""How many fields of an item must not be NaN; those behind them are its reliability or error."""

_SeriesT = TypeVar("_SeriesT", bound=SeriesData)

_QUATERNION: Final = slice(0, 4)
"""The fields q0, qx, qy, qz of a tool."""


def resample(
    series: _SeriesT, rate_hz: float, max_gap_s: float, from_s: float | None, to_s: float | None
) -> _SeriesT:
    """Return a series at another rate: see ``Series.resample``."""
    if series.component is ComponentType.EVENT:
        raise TakeError("events have no rate and cannot be resampled; each has a time of its own")
    if not (0 < rate_hz <= _MAX_RATE_HZ and max_gap_s >= 0):
        raise TakeError(
            f"cannot resample to {rate_hz:g} Hz across gaps of {max_gap_s:g} s; the rate must be above 0 and "
            f"at most {_MAX_RATE_HZ} Hz, and gaps at least 0 s"
        )
    times = _grid(series, rate_hz, from_s, to_s)
    parts = [part for run in series.without_empty_frames().runs() for part in _between_clock_steps(run)]
    runs = sorted(parts, key=lambda run: int(run.capture_utime.min()))
    bounds = np.searchsorted(times, [run.capture_utime.min() for run in runs]).tolist()
    bounds = [0, *bounds[1:], len(times)]
    items: dict[int, list[Array]] = {}
    nearest: list[tuple[_SeriesT, Array]] = []
    for run, first, stop in zip(runs, bounds, bounds[1:], strict=False):
        values, frames = _interpolate(run, times[first:stop], max_gap_s * 1e6)
        [(number, recorded)] = run.content.recorded.items()
        items.setdefault(number, []).append(values.view(recorded.dtype).reshape(len(values), number))
        nearest.append((run, frames))
    columns = {
        name: np.concatenate([run.content.columns[name][frames] for run, frames in nearest])
        for name in series.content.columns
    }
    columns["capture_utime"] = times
    content = SeriesContent(
        columns,
        {number: np.concatenate(found) for number, found in items.items()},
        series.content.parameters,
        np.concatenate([run.content.entries[frames] for run, frames in nearest]),
    )
    return type(series)(series.component, content, series.start_utime, rate_hz)


def _between_clock_steps(run: _SeriesT) -> list[_SeriesT]:
    """Return the parts of a run between steps back of the gateway's clock, after which times occur again."""
    order = np.argsort(run.sequence, kind="stable")
    steps = np.diff(run.capture_utime[order])
    (places,) = np.nonzero(steps < -(regular_step(steps) or 0) / 2)
    return [run.rows(np.sort(chosen)) for chosen in np.split(order, places + 1)] if len(places) else [run]


def _grid(series: SeriesData, rate_hz: float, from_s: float | None, to_s: float | None) -> Array:
    """Return the times in µs since 1970, int64: multiples of the period since the beginning of the take."""
    first_s = float(series.seconds.min()) if from_s is None else from_s
    last_s = float(series.seconds.max()) if to_s is None else to_s
    if not (math.isfinite(first_s) and math.isfinite(last_s)):
        raise TakeError(f"cannot resample from {first_s:g} s to {last_s:g} s; give numbers, or None for all")
    first, last = math.ceil(first_s * rate_hz - 1e-6), math.floor(last_s * rate_hz + 1e-6)
    num_rows = last - first + 1
    # A pause of days, or a damaged time of capture, would become rows of NaN that fill the memory.
    row_bytes = HEAD.itemsize + len(series.labels) * NATIVE_ITEM_DTYPES[series.component].itemsize
    frames_at_rate = len(series) * rate_hz / (series.measured_rate_hz or rate_hz)
    if num_rows < 1 or num_rows * row_bytes > max(MAX_PADDING * frames_at_rate * row_bytes, MIN_LIMIT_BYTES):
        raise TakeError(
            f"{series.key} cannot be resampled to {rate_hz:g} Hz from {first_s:.3f} s to {last_s:.3f} s: its "
            f"{len(series)} frames would become {num_rows} rows; resample parts by from_s and to_s"
        )
    elapsed_us: Array = np.rint(np.arange(first, last + 1) * (1e6 / rate_hz)).astype(np.int64)
    return elapsed_us + series.start_utime


def _interpolate(run: SeriesData, times: Array, max_gap_us: float) -> tuple[Array, Array]:
    """Return the values of a run at these times, float32, and the index of the nearest frame of each.

    The shape of the values is (times, items * fields). Values that are missing do not count: an item is
    interpolated between the frames before and after that have it.
    """
    order = np.argsort(run.capture_utime, kind="stable")
    order = order[np.concatenate([[True], np.diff(run.capture_utime[order]) > 0])]
    captures = run.capture_utime[order]
    max_gap_us = max(max_gap_us, _NEIGHBOURS * (regular_step(np.diff(captures)) or 0))
    values = run.values.reshape(*run.items.shape, -1 if run.items.size else 1)[order]
    is_there = ~np.isnan(values[..., : _NUM_VALUES[run.component]]).any(axis=-1)
    is_rotation = run.component is ComponentType.TOOLS
    result = np.full((len(times), *values.shape[1:]), MISSING, np.float32)
    always = is_there.all(axis=0)
    groups = [(always, np.arange(len(captures)))] if always.any() else []
    groups += [(np.array([item]), np.flatnonzero(is_there[:, item])) for item in np.flatnonzero(~always)]
    for items, frames in groups:
        if not len(frames):
            continue
        recorded = captures[frames], values[frames][:, items]
        for start in range(0, len(times), _BLOCK_ROWS):
            block = slice(start, start + _BLOCK_ROWS)
            result[block, items] = _between(*recorded, times[block], max_gap_us, is_rotation=is_rotation)
    after = np.clip(np.searchsorted(captures, times), 1, max(len(captures) - 1, 1))
    after = np.minimum(after, len(captures) - 1)
    before = np.maximum(after - 1, 0)
    is_before = times - captures[before] <= captures[after] - times
    return result.reshape(len(times), -1), order[np.where(is_before, before, after)]


def _between(captures: Array, values: Array, times: Array, max_gap_us: float, *, is_rotation: bool) -> Array:
    """Return values, shape (captures, items, fields), at other times, float32; NaN in longer gaps."""
    before = np.clip(np.searchsorted(captures, times, side="right") - 1, 0, len(captures) - 1)
    after = np.minimum(before + (captures[before] < times), len(captures) - 1)
    gap_us = captures[after] - captures[before]
    weight = ((times - captures[before]) / np.maximum(gap_us, 1))[:, None, None]
    low, high = values[before].astype(np.float64), values[after].astype(np.float64)
    with np.errstate(invalid="ignore"):  # between infinite values, and of a quaternion that is 0
        result = low + weight * (high - low)
        if is_rotation:
            result[..., _QUATERNION] = slerp(low[..., _QUATERNION], high[..., _QUATERNION], weight)
    result = np.where(weight == 0, low, result)  # as recorded, also infinite values
    is_outside = (times < captures[0]) | (times > captures[-1])
    result[is_outside | (gap_us > max_gap_us)] = MISSING
    return result.astype(np.float32)


def slerp(low: Array, high: Array, weight: Array) -> Array:
    """Return rotations between two quaternions at constant angular velocity, the shorter way round.

    Shape (…, 4), normalized; ``weight`` from 0 to 1 has the shape (…, 1).
    """
    low = low / np.linalg.norm(low, axis=-1, keepdims=True)
    high = high / np.linalg.norm(high, axis=-1, keepdims=True)
    cosine = (low * high).sum(axis=-1, keepdims=True)
    high = np.where(cosine < 0, -high, high)
    angle = np.arccos(np.clip(abs(cosine), 0, 1))
    sine = np.sin(angle)
    is_small = sine < 1e-6  # then, the arc is as good as a line
    sine = np.where(is_small, 1, sine)
    result = np.where(is_small, 1 - weight, np.sin((1 - weight) * angle) / sine) * low
    result += np.where(is_small, weight, np.sin(weight * angle) / sine) * high
    return np.asarray(result / np.linalg.norm(result, axis=-1, keepdims=True))
