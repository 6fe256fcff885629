"""The period of a run's frames: the time between one frame and the next, although some are late or missing.

Stamps have a jitter, single ones are wrong, frames are missing, and the rate may change within a run. So the
slope of the times is taken in blocks of frames; the median of the blocks decides which of them have the rate
of the run, and all of those together say what it is.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from gateway.takes.files.component_rows import Array
from gateway.takes.files.spool import release_pages

_BLOCK_FRAMES: Final = 64
_LOWER: Final = 0.3
"""Gaps that the numbers do not show make periods longer only, so this part of a block decides, not half."""

_BLOCKS_AT_ONCE: Final = 4000

_MAX_COUNTED: Final = 1000
"""How many frames a step of numbers may count, so that a damaged number does no harm."""

_FITS_ROWS: Final = 1.0
"""How far, in periods, the time between two frames may be from what their numbers say."""

_MOSTLY: Final = 0.8
_RARELY: Final = 0.1
_FITS_LATE_ROWS: Final = 4.0
"""The same, if mostly it is not further, or if few are missing: then frames are late, and their numbers are
right."""

_FITS_PART: Final = 0.01
"""How much further than that, as a part of the time, because the period is not known exactly at first."""

_GAP_ROWS: Final = 1.75
_JUMP_ROWS: Final = 0.65
"""A step of more than _GAP_ROWS is a gap if it moves the median of three frames by _JUMP_ROWS and by its
length: otherwise, a frame was only late."""
_CATCHES_UP_ROWS: Final = 0.6
"""The step after a frame that was only late is shorter than this."""

_NUM_PASSES: Final = 2
"""With the period of the first pass, more gaps are seen."""

_ROUGH: Final = 0.2
"""How wrong, as a part of it, the period may be at first, because of gaps that the numbers do not show."""

_SAME_RATE: Final = 0.01
_OTHER_RATE: Final = 0.05
"""Blocks whose periods differ by less, or by more than this part have the same rate, or another one."""


class RunTimes(NamedTuple):
    """The numbers of a run's frames and their times in µs, in the order of their numbers.

    ``number_step`` is how much the server's numbers grow from one recorded frame to the next.
    """

    sequence: Array
    frame_number: Array
    times_us: Array
    number_step: int

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.times_us)

    def part(self, start: int, stop: int) -> "RunTimes":
        """Return some of the frames."""
        sequence, numbers, times = self.sequence, self.frame_number, self.times_us
        return RunTimes(sequence[start:stop], numbers[start:stop], times[start:stop], self.number_step)

    def counted(self) -> Array:
        """Return how many frames the numbers count from each frame to the next; 1 if they do not say."""
        by_number, rest = np.divmod(np.diff(self.frame_number.astype(np.int64)), self.number_step)
        by_number[rest != 0] = 0
        by_sequence = np.diff(self.sequence)
        by_number[(by_number < 1) | (by_number > _MAX_COUNTED)] = 0
        by_sequence = np.where((by_sequence < 1) | (by_sequence > _MAX_COUNTED), 1, by_sequence)
        found: Array = np.where(by_number > 0, by_number, by_sequence)
        return found

    def steps(self, period_us: float) -> Array:
        """Return how many rows follow each frame at least: what the numbers count, if the times agree."""
        counted = self.counted()
        elapsed = np.diff(self.times_us) / period_us
        differences = abs(elapsed - counted) - _FITS_PART * counted
        fits = differences <= _FITS_ROWS
        num_gaps, num_fitting = np.count_nonzero(counted > 1), np.count_nonzero(fits & (counted > 1))
        if num_fitting > _MOSTLY * num_gaps or num_gaps < _RARELY * len(counted):
            fits = differences <= _FITS_LATE_ROWS
        steps: Array = np.where(fits, counted, 1)
        return steps


def number_step(frame_number: Array) -> int:
    """Return how much the server's numbers grow from one frame to the next, mostly; 1 if they do not grow."""
    steps = np.diff(frame_number[: 100 * _BLOCK_FRAMES].astype(np.int64))
    steps = steps[steps > 0]
    return int(np.quantile(steps, 0.5, method="lower")) if len(steps) else 1


def measured_period_us(run: RunTimes) -> float | None:
    """Return the time between neighbouring frames; None if it is not known."""
    periods_us = block_periods_us(run)
    periods_us = periods_us[periods_us > 0]
    if not len(periods_us):
        return None
    period_us = float(np.quantile(periods_us, 0.5, method="lower"))
    for _ in range(_NUM_PASSES):
        period_us = _refined(run, period_us)
    return period_us


def _refined(run: RunTimes, rough_us: float) -> float:
    """Return a better period."""
    size = _block_size(len(run))
    fits = [_lines(part, size, rough_us) for part in _parts(run, size)]
    slopes, rows, times = (np.concatenate(found) for found in zip(*fits, strict=True))
    near = slopes[abs(slopes / rough_us - 1) <= _ROUGH]
    if not len(near):
        return rough_us
    period_us = float(np.median(near))
    if len(slopes) == 1:
        return period_us
    # Neighbouring blocks of this rate make long lines, whose slopes are exact.
    is_good = abs(slopes / period_us - 1) <= _SAME_RATE
    linked = is_good[1:] & is_good[:-1]
    linked &= abs(np.diff(times) / period_us - np.diff(rows)) <= _FITS_ROWS
    (breaks,) = np.nonzero(~linked)
    products = squares = 0.0
    for first, end in zip([0, *(breaks + 1).tolist()], [*(breaks + 1).tolist(), len(slopes)], strict=True):
        row, time = rows[first:end] - rows[first:end].mean(), times[first:end] - times[first:end].mean()
        if is_good[first]:
            products += float(row @ time)
            squares += float(row @ row)
    return products / squares if squares > 0 else period_us


def block_periods_us(run: RunTimes) -> Array:
    """Return about the period of each block of frames, by what their numbers count."""
    size = _block_size(len(run))
    if len(run) < 2:
        return np.empty(0)
    distance = min(max(size // 4, 1), _BLOCK_FRAMES // 4)
    found = []
    for part in _parts(run, size):
        rows = np.concatenate([[0], np.cumsum(part.counted())]).reshape(-1, size)
        times = part.times_us.reshape(-1, size)
        slopes = (times[:, distance:] - times[:, :-distance]) / (rows[:, distance:] - rows[:, :-distance])
        found.append(np.quantile(slopes, _LOWER, axis=1))
    return np.concatenate(found)


def rate_changes(run: RunTimes) -> list[int]:
    """Return the frames from which on the frames have another rate, for at least two blocks."""
    size = _block_size(len(run))
    periods = block_periods_us(run)
    changes: list[int] = []
    first = 0
    for block in range(2, len(periods) - 1):
        if block < first + 2:
            continue
        own = float(np.median(periods[first:block]))
        if own > 0 and (abs(periods[block : block + 2] / own - 1) > _OTHER_RATE).all():
            changes.append(_kink(run, (block - 1) * size, (block + 1) * size, own, float(periods[block + 1])))
            first = block + 1
    return changes


def _kink(run: RunTimes, start: int, stop: int, before_us: float, after_us: float) -> int:
    """Return the frame between two at which the period changes."""
    times = run.times_us[start:stop] - run.times_us[start]
    rows = np.concatenate([[0], np.cumsum(run.part(start, stop).counted())])
    bent = times - rows * (before_us + after_us) / 2
    return start + int(bent.argmax() if before_us > after_us else bent.argmin())


def _lines(run: RunTimes, size: int, period_us: float) -> tuple[Array, Array, Array]:
    """Return the slope of the line through each block of frames, and the middle of it: its row and time."""
    steps = run.steps(period_us)
    elapsed = np.diff(run.times_us) / period_us
    shifts = np.concatenate([np.zeros(3), np.cumsum(elapsed - steps), np.zeros(2)])
    shifts[-2:] = shifts[-3]
    medians = np.median(sliding_window_view(shifts, 3), axis=1)
    jumps = medians[3:] - medians[: len(elapsed)]
    lengths = 1 + np.round(np.clip(jumps, 0, _MAX_COUNTED))
    is_gap = (elapsed >= _GAP_ROWS) & (abs(elapsed - lengths) <= 1) & (steps == 1) & (jumps >= _JUMP_ROWS)
    follows = np.concatenate([elapsed[1:], [1.0]]) if len(elapsed) else elapsed
    is_gap &= (lengths > 2) | (follows >= _CATCHES_UP_ROWS)
    steps = np.where(is_gap, lengths, steps)
    rows = np.concatenate([[0.0], np.cumsum(steps)]).reshape(-1, size)
    times = (run.times_us - run.times_us[0]).astype(np.float64).reshape(-1, size)
    row, time = rows - rows.mean(axis=1, keepdims=True), times - times.mean(axis=1, keepdims=True)
    slopes = (row * time).sum(axis=1) / (row * row).sum(axis=1)
    return slopes, rows.mean(axis=1), times.mean(axis=1)


def _parts(run: RunTimes, size: int) -> Iterator[RunTimes]:
    """Yield parts of the frames, each of whole blocks; the rest at the end does not fill one."""
    for start in range(0, len(run) // size * size, _BLOCKS_AT_ONCE * size):
        yield run.part(start, min(start + _BLOCKS_AT_ONCE * size, len(run) // size * size))
        release_pages()


def _block_size(num_frames: int) -> int:
    """Return how many frames a block has: all of them, if there are few."""
    return _BLOCK_FRAMES if num_frames >= 2 * _BLOCK_FRAMES else max(num_frames, 1)
