"""Every sample of the last 10 s is within the envelope, however the samples are batched."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gateway.tools.display.view.plots import COLUMN_US, NUM_COLUMNS, Envelope

START_UTIME = 1_700_000_000_000_000

values = st.floats(allow_nan=True, allow_infinity=True, width=32)
steps_us = st.lists(st.tuples(st.integers(0, 3 * COLUMN_US), values), min_size=1, max_size=200)
"""The time since the sample before, and the value."""


def times_and_values(steps: list[tuple[int, float]], start_utime: int) -> tuple[np.ndarray, np.ndarray]:
    utimes = start_utime + np.cumsum([step for step, _ in steps])
    return utimes, np.array([value for _, value in steps], np.float32)


def filled(utimes: np.ndarray, samples: np.ndarray, cuts: list[int]) -> Envelope:
    envelope = Envelope()
    places = sorted(cut % (len(utimes) + 1) for cut in cuts)
    for times, batch in zip(np.split(utimes, places), np.split(samples, places), strict=True):
        envelope.add(times.astype(">i8"), batch)
    return envelope


@given(steps_us, st.lists(st.integers(0, 1000), max_size=5), st.integers(-START_UTIME * 2, START_UTIME))
def test_every_sample_is_inside(steps: list[tuple[int, float]], cuts: list[int], offset_us: int) -> None:
    utimes, samples = times_and_values(steps, START_UTIME + offset_us)
    lowest, highest = filled(utimes, samples, cuts).columns(int(utimes[-1]))
    assert lowest.shape == highest.shape == (NUM_COLUMNS,)
    columns = utimes // COLUMN_US - utimes[-1] // COLUMN_US + NUM_COLUMNS - 1
    for column in range(NUM_COLUMNS):
        in_column = samples[(columns == column) & np.isfinite(samples)].astype(np.float64)
        if len(in_column):
            assert (lowest[column], highest[column]) == (in_column.min(), in_column.max())
        else:
            assert np.isnan(lowest[column])
            assert np.isnan(highest[column])


@given(steps_us, st.lists(st.integers(0, 1000), max_size=5), st.integers(0, 2 * NUM_COLUMNS))
def test_batches_make_no_difference_and_the_end_only_shifts(
    steps: list[tuple[int, float]], cuts: list[int], later: int
) -> None:
    utimes, samples = times_and_values(steps, START_UTIME)
    end_utime = int(utimes[-1])
    whole = filled(utimes, samples, []).columns(end_utime)
    shifted = filled(utimes, samples, cuts).columns(end_utime + later * COLUMN_US)
    kept = max(0, NUM_COLUMNS - later)
    for expected, found in zip(whole, shifted, strict=True):
        assert np.array_equal(found[:kept], expected[NUM_COLUMNS - kept :], equal_nan=True)
        assert np.isnan(found[kept:]).all()


@given(steps_us, steps_us, st.integers(2, 10_000) | st.integers(-10_000, -2))
def test_times_that_jump_begin_anew(
    before: list[tuple[int, float]], after: list[tuple[int, float]], jump_s: int
) -> None:
    envelope = Envelope()
    utimes, samples = times_and_values(before, START_UTIME)
    envelope.add(utimes, samples)
    later_utimes, later = times_and_values(after, int(utimes[-1]) + jump_s * 1_000_000)
    envelope.add(later_utimes, later)
    alone = Envelope()
    alone.add(later_utimes, later)
    end_utime = int(later_utimes[-1])
    for expected, found in zip(alone.columns(end_utime), envelope.columns(end_utime), strict=True):
        assert np.array_equal(found, expected, equal_nan=True)
