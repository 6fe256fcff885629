"""Frames on a grid: by time stamps, not by times of capture, and missing frames keep their places."""

from pathlib import Path

import numpy as np
import pytest

from gateway.rtc3d.parameters import Marker, Parameters, Parameters3D
from gateway.takes import open_take
from gateway.takes.export.grid import Grid, place
from gateway.takes.export.measurements import ExportedMeasurement
from gateway.takes.files import spool
from gateway.takes.files.series import Series
from gateway.takes.files.take import TakeSource
from tests.support.takes import START_UTIME, markers, parameters, write_take


def series(
    tmp_path: Path, rows: list[tuple[int, int]], announced_hz: float | None = 100.0, **options: int
) -> Series:
    """Return markers with these sequence numbers and time stamps in µs; capture has a jitter of 3 ms."""
    jitter = np.random.default_rng(3)
    messages = [
        markers(
            1,
            sequence,
            timestamp_us=time,
            utime=START_UTIME + sequence * 10_000 + int(jitter.integers(3000)),
            **options,
        )
        for sequence, time in rows
    ]
    described = Parameters(markers=Parameters3D(announced_hz, "mm", (Marker("1", "head"),)))
    take = open_take(write_take(tmp_path / "a.lcmlog", [parameters(described), *messages]))
    found = take.sources["lab"].markers
    assert found
    return found


def grid(tmp_path: Path, rows: list[tuple[int, int]], announced_hz: float | None = 100.0) -> Grid:
    (found,) = place(series(tmp_path, rows, announced_hz))
    return found


def frames_of(grid: Grid) -> list[int]:
    """Return the indices of the frames, which are a slice if all follow each other."""
    return [int(frame) for frame in np.arange(10_000)[grid.frames]]


JITTER_US = np.random.default_rng(1).integers(-2000, 2000, 500).tolist()


@pytest.mark.parametrize(
    "stamps",
    [
        pytest.param([10_000 * n for n in range(50)], id="exact"),
        pytest.param([123], id="a single frame"),
        pytest.param([round(10_010.3 * n) for n in range(5000)], id="a clock that is 0.1 % fast"),
        pytest.param([10_000 * n + jitter_us for n, jitter_us in enumerate(JITTER_US)], id="jitter"),
    ],
)
def test_frames_follow_each_other_at_the_announced_rate(tmp_path: Path, stamps: list[int]) -> None:
    found = grid(tmp_path, [*enumerate(stamps)])
    assert (found.rate_hz, found.num_rows) == (100.0, len(stamps))
    assert found.rows.tolist() == frames_of(found) == [*range(len(stamps))]


@pytest.mark.parametrize("lost_before_the_gateway", [True, False])
def test_missing_frames_keep_their_rows(tmp_path: Path, lost_before_the_gateway: bool) -> None:
    kept = [n for n in range(50) if n not in (7, 20, 21, 22)]
    rows = [(place if lost_before_the_gateway else n, 10_000 * n) for place, n in enumerate(kept)]
    assert grid(tmp_path, rows).rows.tolist() == kept


@pytest.mark.parametrize(
    ("announced_hz", "step_us", "expected_hz"),
    [
        (100.0, 50_000, 20.0),
        (59.94, 16683.35, 59.94),
        (None, 5000, 200.0),
        (2000.0, 7_000, 1e6 / 7000),
        (1000.0, 33_333.3, 30.0),
    ],
)
def test_the_rate_is_the_announced_one_if_that_was_recorded(
    tmp_path: Path, announced_hz: float | None, step_us: float, expected_hz: float
) -> None:
    found = grid(tmp_path, [(n, int(step_us * n)) for n in range(300)], announced_hz)
    assert found.rate_hz == pytest.approx(expected_hz, rel=1e-3)
    assert found.num_rows == 300


def test_without_time_stamps_the_sequence_numbers_place_the_frames(tmp_path: Path) -> None:
    kept = [n for n in range(50) if n not in (7, 20)]
    found = grid(tmp_path, [(n, 0) for n in kept])
    assert found.rows.tolist() == kept
    assert found.rate_hz == 100.0
    assert not found.has_time_stamps


def test_overtaken_and_repeated_messages_have_their_places(tmp_path: Path) -> None:
    order = [0, 1, 3, 2, 4, 4, 5]
    found = grid(tmp_path, [(n, 10_000 * n) for n in order])
    assert found.rows.tolist() == [0, 1, 2, 3, 4, 5]
    assert [order[frame] for frame in frames_of(found)] == [0, 1, 2, 3, 4, 5]


def test_nonsense_of_a_time_stamp_takes_no_memory(tmp_path: Path) -> None:
    stamps = [0, 10_000, 20_000, 2**62, 2**62 + 10_000, 2**62 + 20_000]
    grids = place(series(tmp_path, list(enumerate(stamps))))
    assert [found.num_rows for found in grids] == [3, 3]


def test_the_numbers_place_frames_on_both_sides_of_a_gap_whatever_their_jitter(tmp_path: Path) -> None:
    """Of blocks of few frames, the jitter alone gave a period so wrong that frames moved by a row."""
    random = np.random.default_rng(2886766720)
    stamps = 10_020 * np.arange(287) + random.integers(-3000, 3000, 287, endpoint=True)
    stamps[14::50] += 8000
    is_kept = random.random(287) >= 0.3
    is_kept[115:160] = False
    kept = np.flatnonzero(is_kept).tolist()
    found = grid(tmp_path, [(number, 10**6 + int(stamps[number])) for number in kept])
    assert found.rows.tolist() == [number - kept[0] for number in kept]
    assert found.measured_hz == pytest.approx(1e6 / 10_020, rel=5e-4)


@pytest.mark.parametrize("step_us", [4900, 1, 0, -3000])
def test_two_frames_never_share_a_row(tmp_path: Path, step_us: int) -> None:
    """A time stamp that is much too early would otherwise overwrite the frame before it."""
    stamps = [10_000 * number for number in range(20)]
    stamps[10] = stamps[9] + step_us
    found = grid(tmp_path, [*enumerate(stamps)])
    assert found.rows.tolist()[:11] == [*range(11)]
    assert np.all(np.diff(found.rows) >= 1)


@pytest.mark.parametrize(("gap_s", "num_grids"), [(10.0, 1), (10.01, 2)])
def test_only_a_gap_of_up_to_ten_seconds_is_filled(tmp_path: Path, gap_s: float, num_grids: int) -> None:
    """Empty rows for a break of an hour would make a file of gigabytes."""
    rows = [(n, 10_000 * n) for n in range(5)]
    rows += [(5 + n, 40_000 + round(gap_s * 1e6) + 10_000 * n) for n in range(4)]
    grids = place(series(tmp_path, rows))
    assert [each for found in grids for each in frames_of(found)] == [*range(9)]
    assert [found.rows[0] for found in grids] == [0] * num_grids
    assert [len(found.rows) for found in grids] == [[9], [5, 4]][num_grids - 1]


def test_the_rate_of_capture_is_the_slope_through_all_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spool, "_PIECE_ROWS", 7)
    found = series(tmp_path, [(n, 10_010 * n) for n in range(100) if n % 9])
    [placed] = place(found)
    measurement = ExportedMeasurement(TakeSource("lab"), {}, found, placed)
    slope_us = np.polyfit(placed.rows, found.capture_utime - START_UTIME, 1)[0]
    assert measurement.captured_rate_hz == pytest.approx(1e6 / slope_us, rel=1e-9)
    assert 99 < 1e6 / slope_us < 101
    single = series(tmp_path, [(0, 0)])
    [placed] = place(single)
    assert measurement._replace(base=single, grid=placed).captured_rate_hz is None


@pytest.mark.parametrize("lost", [(), (4, 11)])
@pytest.mark.parametrize("every", [1, 3])
def test_frames_sent_twice_leave_no_empty_rows_without_frame_numbers(
    tmp_path: Path, lost: tuple[int, ...], every: int
) -> None:
    """The gateway counts them, and its numbers are the only ones if the server has none."""
    rows: list[tuple[int, int]] = []
    sequence = 0
    for number in range(60):
        for _ in range(2 if number % every == 0 else 1):
            if number not in lost:
                rows.append((sequence, 5_000_000 + 10_000 * number))
            sequence += 1
    found = place(series(tmp_path, rows, frame_number=7))[0]
    assert found.rows.tolist() == [number for number in range(60) if number not in lost]
    assert (found.rate_hz, len(found.skipped_rows)) == (100, 0)
    assert found.num_repeated == len(rows) - len(found.rows)
