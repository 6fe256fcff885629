"""The grid of exports against a plain model of a server's frames.

The model knows when each frame was captured. Whatever happens to the time stamps and to the frames on their
way, each row has the time of its frame, rows increase, and nothing is called missing that was not lost.
"""

from typing import Final, NamedTuple

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gateway.rtc3d.components import MISSING, ComponentType
from gateway.rtc3d.parameters import Marker, Parameters, Parameters3D
from gateway.takes.export.grid import Grid, place
from gateway.takes.files.component_rows import HEAD, NATIVE_ITEM_DTYPES, Array
from gateway.takes.files.parameters_history import ParametersEntry
from gateway.takes.files.series import Series
from gateway.takes.files.series_data import SeriesContent

PERIOD_US: Final = 10_000


class Frames(NamedTuple):
    """What arrives of a server's frames, one after another: the time at which each was captured, its time
    stamp, and the server's number, in its steps."""

    captured_us: Array
    stamps_us: Array
    numbers: Array

    def __repr__(self) -> str:
        return f"<{len(self.numbers)} frames>"

    def kept(self, places: Array) -> "Frames":
        return Frames(*(array[places] for array in self))


def series_of(frames: Frames, announced_hz: float | None = 1e6 / PERIOD_US) -> Series:
    """Return the markers of a take with these frames, in the order of their arrival."""
    count = len(frames.stamps_us)
    columns = {name: np.zeros(count, HEAD[name].newbyteorder("=")) for name in HEAD.names or ()}
    columns["sequence"][:] = np.arange(count)
    columns["frame_number"][:] = frames.numbers
    columns["timestamp_us"][:] = frames.stamps_us
    columns["utime"][:] = columns["capture_utime"][:] = 10**15 + frames.stamps_us
    columns["num_items"][:] = 1
    items = np.full((count, 1), MISSING, NATIVE_ITEM_DTYPES[ComponentType.MARKERS])
    described = Parameters(markers=Parameters3D(announced_hz, "mm", (Marker("1", "head"),)))
    entries = np.zeros(count, np.int64)
    content = SeriesContent(columns, {1: items}, [ParametersEntry(0, 0, described, b"")], entries)
    return Series(ComponentType.MARKERS, content, 10**15)


@st.composite
def servers(
    draw: st.DrawFn, jitters_us: tuple[int, ...] = (0, 1, 500, 3000), *, may_be_late: bool = True
) -> tuple[Frames, float, np.random.Generator]:
    """Return all frames of a server with one rate, whose clock may drift, and the jitter of its stamps."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(200, 1000))
    drift = draw(st.sampled_from([0.0, 1e-4, -1e-4, 2e-3, -2e-3]))
    number_step = draw(st.sampled_from([1, 1, 2, 5]))
    captured_us = 10**6 + np.arange(count) * PERIOD_US * (1 + drift)
    jitter_us = draw(st.sampled_from(jitters_us))
    stamps_us = captured_us + random.integers(-jitter_us, jitter_us, count, endpoint=True)
    if may_be_late and draw(st.booleans()):
        places = np.arange(draw(st.integers(0, 49)), count, 50)
        stamps_us[places] += draw(st.sampled_from([4000, 6000, 8000]))
    numbers = draw(st.integers(1, 10**6)) + number_step * np.arange(count)
    return Frames(captured_us, stamps_us.astype(np.int64), numbers), jitter_us, random


def errors_us(grid: Grid, captured_us: Array) -> Array:
    """Return how much later each row is than its frame was captured, beside the first ones."""
    period_us = 1e6 / grid.measured_hz
    errors: Array = grid.rows * period_us - captured_us[grid.frames]
    return np.asarray(errors - np.median(errors[:100]))


@given(servers(), st.sampled_from([0.0, 0.01, 0.3]), st.booleans(), st.booleans())
def test_each_frame_has_its_row_whatever_the_network_loses_and_repeats(
    server: tuple[Frames, float, np.random.Generator], lost: float, is_bursty: bool, repeats: bool
) -> None:
    """Numbers that go on say that nothing is missing, and those that jump how much is; no error adds up."""
    frames, _, random = server
    count = len(frames.numbers)
    is_kept = random.random(count) >= lost
    if is_bursty:
        first = int(random.integers(20, count - 100))
        is_kept[first : first + int(random.integers(1, 80))] = False
    kept = np.flatnonzero(is_kept)
    arrived = frames.kept(np.repeat(kept, 1 + repeats * random.integers(0, 3, len(kept))))
    [grid] = place(series_of(arrived))
    assert (np.diff(grid.rows) > 0).all()
    assert grid.num_repeated == len(arrived.numbers) - len(kept)
    assert grid.rows.tolist() == (kept - kept[0]).tolist()
    assert not len(grid.skipped_rows)
    assert abs(errors_us(grid, arrived.captured_us)).max() < PERIOD_US / 2


@given(
    servers((0, 1, 500), may_be_late=False),
    st.lists(st.tuples(st.integers(1, 120), st.integers(1, 30)), max_size=5),
)
def test_gaps_that_only_the_time_stamps_show_stay_gaps(
    server: tuple[Frames, float, np.random.Generator], losses: list[tuple[int, int]]
) -> None:
    """A server that numbers only what it sends: each row has the time of its frame, and those between are
    known to be no frames that were lost."""
    frames, _, _ = server
    is_kept = np.full(len(frames.numbers), True)
    place_of = 20
    for distance, length in losses:
        place_of += 20 + distance
        is_kept[place_of : place_of + length] = False
        place_of += length
    is_kept[-20:] = True
    kept = np.flatnonzero(is_kept)
    arrived = frames.kept(kept)._replace(numbers=frames.numbers[: len(kept)])
    [grid] = place(series_of(arrived))
    assert (np.diff(grid.rows) > 0).all()
    assert abs(errors_us(grid, arrived.captured_us)).max() < 1.1 * PERIOD_US
    expected = np.flatnonzero(~is_kept)
    assert abs(len(grid.skipped_rows) - len(expected)) <= 1
    assert grid.rows[-1] + 1 == len(kept) + len(grid.skipped_rows)


@given(
    st.lists(
        st.tuples(st.sampled_from([50.0, 71.0, 85.0, 100.0, 120.0]), st.integers(200, 800)),
        min_size=1,
        max_size=4,
    ),
    st.sampled_from([0, 1000, 3000]),
    st.integers(0, 2**32 - 1),
)
def test_the_rate_may_change(parts: list[tuple[float, int]], jitter_us: int, seed: int) -> None:
    """Each frame is in its place, or in a grid of its own, or the error is reported."""
    steps = np.concatenate([np.full(count, 1e6 / rate_hz) for rate_hz, count in parts])
    captured_us = np.cumsum(steps)
    jitter = np.random.default_rng(seed).integers(-jitter_us, jitter_us, len(steps), endpoint=True)
    frames = Frames(captured_us, (captured_us + jitter).astype(np.int64), np.arange(len(steps)))
    grids = place(series_of(frames))
    assert np.concatenate([np.arange(len(steps))[grid.frames] for grid in grids]).tolist() == [
        *range(len(steps))
    ]
    for grid in grids:
        assert (np.diff(grid.rows) > 0).all()
        missing = grid.num_rows - len(grid.rows)
        assert len(grid.skipped_rows) == missing
        error_us = abs(errors_us(grid, captured_us)).max()
        assert error_us < 2.5e6 / grid.measured_hz
        if error_us > 1.1e6 / grid.measured_hz:
            assert grid.largest_error_us() > 0.5e6 / grid.rate_hz
