"""The measurements of a take: parts that have one rate, one set of labels and one count of the server's
time.

Each has a grid: see ``grid``.
"""

import math
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from gateway.errors import TakeError
from gateway.messages.descriptions.labels import MAX_EVENT_AGE_US
from gateway.takes.export.grid import Frames, Grid, bounds, place, some_frames
from gateway.takes.export.job import ExportJob, nothing_to_export
from gateway.takes.files.component_rows import Array
from gateway.takes.files.series import Series
from gateway.takes.files.spool import pieces, release_pages
from gateway.takes.files.take import TakeSource

_SAME_CLOCK_S: Final = 0.2
"""Two time stamps are of the same measurement if they differ from the times of capture equally, within
this."""

_MAX_FILES: Final = 1000
"""The most measurements in one export: each becomes a file."""

_COMPARED: Final = 9
"""How many pairs of frames are compared to decide this."""

_SECOND_US: Final = 1_000_000
_MARGIN_US: Final = 1_000_000
"""Frames captured within this time before or after a measurement may belong to it."""


class Part(NamedTuple):
    """Frames of a run in the rows of a measurement: ``rows`` increase, ``frames`` are indices in
    ``series``."""

    series: Series
    rows: Array
    frames: Frames


class Placed:
    """One component of a measurement in its rows; its parts have the same labels."""

    def __init__(self, parts: list[Part]) -> None:
        self.parts = parts
        self.series = parts[0].series
        """A run that has the labels and units of all."""
        self.first_row = min(int(part.rows[0]) for part in parts)
        self.last_row = max(int(part.rows[-1]) for part in parts)

    @property
    def num_items(self) -> int:
        """The number of markers, channels or plates."""
        return int(self.series.values.shape[1])

    def count(self, start: int, stop: int) -> int:
        """Return how many of the rows ``start`` to ``stop`` were recorded."""
        limits = (bounds(part.rows, start, stop) for part in self.parts)
        return sum(last - first for first, last in limits)

    def block(self, start: int, stop: int) -> Array:
        """Return the values of rows ``start`` to ``stop``, NaN where one is missing.

        The shape is (rows, items, fields); of analog, (rows, items).
        """
        block = np.full((stop - start, *self.series.values.shape[1:]), np.nan, np.float32)
        for part in self.parts:
            first, last = bounds(part.rows, start, stop)
            block[part.rows[first:last] - start] = part.series.values[some_frames(part.frames, first, last)]
        release_pages()
        return block


class ExportedMeasurement(NamedTuple):
    """One measurement of a source. ``grid`` has the places of the frames of ``base``.

    ``runs`` are the runs of all components of the source, by key.
    """

    source: TakeSource
    runs: dict[str, list[Series]]
    base: Series
    grid: Grid

    @property
    def frames(self) -> Placed:
        """The frames of ``base`` in their rows."""
        return Placed([Part(self.base, self.grid.rows, self.grid.frames)])

    @property
    def captures(self) -> Array:
        """The times of capture of the frames of ``base``."""
        return self.base.capture_utime[self.grid.frames]

    @property
    def captured_rate_hz(self) -> float | None:
        """The rows per second of capture; None if it is not known.

        It is the slope of the line through all times, because each has a jitter.
        """
        rows, captures = self.grid.rows, self.captures
        mean_row, mean_us = rows.mean(), captures.mean()
        squares = products = 0.0
        for start, stop in pieces(len(rows)):
            steps = rows[start:stop] - mean_row
            squares += float(steps @ steps)
            products += float(steps @ (captures[start:stop] - mean_us))
        return _SECOND_US * squares / products if products > 0 else None

    def runs_of(self, key: str) -> list[Series]:
        """Return the runs of a component that were captured at the time of this measurement."""
        first, last = _limits(self.captures)
        found = []
        for run in self.runs.get(key, []):
            first_of_run, last_of_run = _limits(run.capture_utime)
            if last_of_run >= first - _MARGIN_US and first_of_run <= last + _MARGIN_US:
                found.append(run)
        return found

    def parts(self, run: Series, rows_per_row: int) -> list[Part]:
        """Return the parts of another component's run in this measurement; [] if it is of another one.

        It has ``rows_per_row`` rows in each row of the measurement, of which the first has the same time.
        """
        stop = self.grid.num_rows * rows_per_row
        parts = []
        for grid in place(run, by_time_stamps=self.grid.has_time_stamps):
            first_row = self._row_of(run, grid, rows_per_row)
            if first_row is not None:
                rows = grid.rows
                rows += first_row  # in place: `place` made them for this call, and a copy could take 30 MB
                first, last = bounds(rows, 0, stop)
                if first < last:
                    parts.append(Part(run, rows[first:last], some_frames(grid.frames, first, last)))
        return parts

    def seconds_of(self, times_us: Array, capture_utime: Array) -> Array:
        """Return times of the server in seconds from the first row; NaN if they are of another
        measurement."""
        base_times, base_captures = self.grid.times_us, self.captures
        times = times_us if self.grid.has_time_stamps else capture_utime
        nearest = _nearest(base_times, times)
        offset_us = (capture_utime - times) - (base_captures[nearest] - base_times[nearest])
        belongs = (times >= base_times[0] - _MARGIN_US) & (times <= base_times[-1] + _MARGIN_US)
        belongs &= abs(offset_us) <= _SAME_CLOCK_S * _SECOND_US
        return np.where(belongs, (times - base_times[0]) / _SECOND_US, np.nan)

    def _row_of(self, run: Series, grid: Grid, rows_per_row: int) -> int | None:
        """Return the row of a run's first frame; None if it is not of this measurement."""
        base_times, base_captures = self.grid.times_us, self.captures
        captures = run.capture_utime[grid.frames]
        if grid.has_time_stamps and self.grid.has_time_stamps:
            times = grid.times_us
        else:
            times, base_times = captures, base_captures
        first_us, last_us = base_times[0] - _MARGIN_US, base_times[-1] + _MARGIN_US
        is_near = np.concatenate(
            [
                (times[start:stop] >= first_us) & (times[start:stop] <= last_us)
                for start, stop in pieces(len(times))
            ]
        )
        if not is_near.any():
            return None
        first, last = int(is_near.argmax()), len(times) - 1 - int(is_near[::-1].argmax())
        compared = np.linspace(first, last, _COMPARED).astype(np.int64)
        nearest = _nearest(base_times, times[compared])
        offsets_us = captures[compared] - times[compared] - (base_captures[nearest] - base_times[nearest])
        if abs(np.median(offsets_us)) > _SAME_CLOCK_S * _SECOND_US:
            return None
        # The first frame within the measurement decides: differences of the clocks' rates cannot add up.
        anchor = next((index for index in range(first, last + 1) if times[index] >= base_times[0]), last)
        # Several of them, because single ones are late.
        anchors = slice(anchor, max(anchor + 1, min(anchor + _COMPARED * rows_per_row, last + 1)))
        near = _nearest(base_times, times[anchors])
        period_us = _SECOND_US / (self.grid.rate_hz * rows_per_row)
        distances = (times[anchors] - base_times[near]) / period_us
        first_rows = self.grid.rows[near].astype(np.int64) * rows_per_row + distances - grid.rows[anchors]
        return round(float(np.median(first_rows)))


def named_measurements(
    job: ExportJob, keys: tuple[str, ...], what: str
) -> list[tuple[ExportedMeasurement, Path]]:
    """Return the measurements of a take, each with the name of its file. Raises TakeError if there are none.

    The frames are those of the first component of ``keys`` that a source has; ``what`` is what they are
    called. A measurement begins where the server's time stamps start again or pause for more than 10 s, with
    each session, and where the labels change.
    """
    by_source = {
        source.name: found
        for source in job.open_take({*keys, *job.chosen_format.components}).sources.values()
        if (found := next(measurements_by_component(source, keys), []))
    }
    total = sum(map(len, by_source.values()))
    if not total:
        raise nothing_to_export(job, what)
    check_number(job, total)
    if total > 1:
        job.note("several measurements, each with files of its own", amount=total)
    named = []
    for name, found in by_source.items():
        for number, measurement in enumerate(found, start=1):
            parts = (name if len(by_source) > 1 else "", str(number) if len(found) > 1 else "")
            path = job.file_name(*parts)
            note_grid(job, measurement, path.name)
            named.append((measurement, path))
    return named


def check_number(job: ExportJob, num_measurements: int) -> None:
    """Raise TakeError if there are so many measurements that they would fill a folder with files."""
    if num_measurements > _MAX_FILES:
        raise TakeError(
            f"{job.take} has {num_measurements} measurements, and each becomes a file; "
            "choose a part by --from and --to"
        )


def note_grid(job: ExportJob, measurement: ExportedMeasurement, file: str) -> None:
    """Report that frames have the times of a grid, and by how much these are wrong."""
    grid = measurement.grid
    job.note("times of capture and frame numbers replaced by a regular grid", amount=f"{grid.rate_hz:.6g} Hz")
    _note_repeated(job, measurement.base.key, grid, file)
    error_us = grid.largest_error_us()
    if error_us > 0.5 * _SECOND_US / grid.rate_hz:
        job.note("the server's time stamps differ from the times of the grid", file, f"up to {_ms(error_us)}")
    _note_last_row(job, measurement, measurement.frames, 1, file)


def _note_repeated(job: ExportJob, key: str, grid: Grid, file: str = "") -> None:
    if grid.num_repeated:
        what = f"frames of {key} with the time stamp and the number of the one before left out"
        job.note(what, file, grid.num_repeated)


def _note_last_row(
    job: ExportJob, measurement: ExportedMeasurement, placed: "Placed", rows_per_row: int, file: str
) -> None:
    """Report if the last row of a component has another time than its frame.

    All formats with a grid need this: what is wrong in the times adds up to the end.
    """
    part = max(placed.parts, key=lambda part: int(part.rows[-1]))
    rate_hz = measurement.grid.rate_hz * rows_per_row
    captured_s = float(part.series.seconds_of(part.series.capture_utime[part.frames][-1:])[0])
    late_s = seconds_of_row(measurement, 0) + int(part.rows[-1]) / rate_hz - captured_s
    if abs(late_s) >= 1 / measurement.grid.rate_hz:
        word = "later" if late_s > 0 else "earlier"
        job.note(
            f"the last row of {placed.series.key} is {word} in the file than it was captured",
            file,
            _ms(abs(late_s) * _SECOND_US),
        )


def _ms(microseconds: float) -> str:
    return f"{microseconds / 1000:.1f} ms"


def measurements_by_component(
    source: TakeSource, keys: tuple[str, ...]
) -> Iterator[list[ExportedMeasurement]]:
    """Yield the measurements of each of the components that a source has, with its frames as their base."""
    # A server may send a frame without items while it sees nothing: that is no measurement of its own.
    # Nor is a component that never has any, such as 6D without tools.
    runs = {
        key: series.without_empty_frames().with_constant_labels().runs()
        for key, series in source.series.items()
        if series.labels
    }
    for key in keys:
        if key in runs:
            yield [ExportedMeasurement(source, runs, run, grid) for run in runs[key] for grid in place(run)]


def event_seconds(measurement: ExportedMeasurement) -> Array:
    """Return when the events of the source were, in s from the first row of a measurement.

    Those of another measurement are NaN. The time of an event is its own, or that of its frame if it is far
    from that.
    """
    events = measurement.source.events
    if events is None:
        return np.empty(0)
    own_us = events.items["timestamp"]
    is_near = abs(own_us.astype(np.float64) - events.timestamp_us) <= MAX_EVENT_AGE_US
    times_us = np.where(is_near, own_us, events.timestamp_us)
    return measurement.seconds_of(times_us, events.capture_utime)


_ALONE: Final = {"analog": ".sto", "force": ".mot"}
"""The formats that have one component, at any rate."""

_RATIO_TOLERANCE: Final = 0.02
_MAX_RATIO_ERROR: Final = 0.1
"""How many samples per frame a rate may differ from a multiple of that of the frames."""


def sampled(
    job: ExportJob, measurement: ExportedMeasurement, key: str, samples: int | None
) -> tuple[Placed | None, int | None]:
    """Return a component, and its number of samples in each frame, which must be ``samples`` if given.

    A part of it with another rate or other labels is left out and reported.
    """
    found: dict[tuple[int, tuple[str, ...]], list[Part]] = {}
    for run in measurement.runs_of(key):
        # By the time stamps, because announced rates can be a little wrong. With a ratio that is not the true
        # one, samples would get further away from their frames with each frame.
        own = place(run)[0]
        ratio = own.measured_hz / measurement.grid.measured_hz
        count = round(ratio)
        tolerance = min(_RATIO_TOLERANCE * count, _MAX_RATIO_ERROR)
        fits = count >= 1 and abs(ratio - count) <= tolerance and count == (samples or count)
        parts = measurement.parts(run, max(count, 1))
        if parts:
            _note_repeated(job, key, own)
        if parts and fits:
            found.setdefault((count, run.labels), []).extend(parts)
        elif parts:
            wanted = "that of the analog channels" if samples else "a multiple of that of the frames"
            job.note(f"{key} left out: its rate is not {wanted}; export to {_ALONE[key]} has it")
    if not found:
        return None, samples
    chosen = max(found, key=lambda identity: sum(len(part.rows) for part in found[identity]))
    _note_last_row(job, measurement, Placed(found[chosen]), chosen[0], "")
    if len(found) > 1:
        job.note(f"a part of {key} with other labels or another rate left out; export to .csv has it")
    return Placed(found[chosen]), chosen[0]


def note_missing(
    job: ExportJob, path: Path, measurement: ExportedMeasurement, first: int, count: int
) -> None:
    """Report the rows of a file without a frame: ``count`` rows of the measurement, from ``first`` on."""
    start, stop = bounds(measurement.grid.rows, first, first + count)
    skipped, after = bounds(measurement.grid.skipped_rows, first, first + count)
    num_skipped = after - skipped
    missing = count - (stop - start) - num_skipped
    if missing:
        job.note("frames missing in the take are empty", path.name, f"{missing} of {count}")
    if num_skipped:
        job.note(
            "rows are empty where the server's time stamps jump and its frame numbers go on",
            path.name,
            f"{num_skipped} of {count}",
        )


def _limits(times: Array) -> tuple[int, int]:
    """Return the first and the last of times that need not be in order."""
    limits = [(times[start:stop].min(), times[start:stop].max()) for start, stop in pieces(len(times))]
    return int(min(first for first, _ in limits)), int(max(last for _, last in limits))


def _nearest(times: Array, wanted: Array) -> Array:
    """Return the indices of the times that are nearest to the wanted ones."""
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(times) - 1)
    return np.where(wanted - times[before] <= times[after] - wanted, before, after)


# The zero of time in exported files is the beginning of the take, which is the time of its first message:
# `open_take`, the columns `time_s` of CSV and `Time` of TRC, and --from and --to count from it. MCAP has
# times since 1970. A C3D file can only count from its first frame; it says how much later that is.

_AVERAGED_S: Final = 1.0
"""The frames of this duration decide when the first one was, because times of capture have a jitter."""

_CLOCK_STEP_S: Final = 0.2
"""Frames whose times differ more than this from that of the first one come after a step of the clock."""

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


def seconds_of_row(measurement: ExportedMeasurement, row: int) -> float:
    """Return when a row of a measurement was captured, in seconds since the beginning of the take."""
    base, grid = measurement.base, measurement.grid
    _, num_first = bounds(grid.rows, 0, max(math.ceil(_AVERAGED_S * grid.rate_hz), 1))
    starts_s = base.seconds_of(measurement.captures[:num_first]) - grid.rows[:num_first] / grid.rate_hz
    same_clock = abs(starts_s - starts_s[0]) <= _CLOCK_STEP_S
    return float(np.median(starts_s[same_clock])) + row / grid.rate_hz


def utc_text(measurement: ExportedMeasurement, seconds: float = 0.0) -> str:
    """Return a time of the take as in 2026-11-22T14:49:19.731938Z."""
    utime = measurement.base.start_utime + round(seconds * 1e6)
    try:
        time = _EPOCH + timedelta(microseconds=utime)
    except OverflowError:
        return f"{utime} microseconds since 1970"
    return time.isoformat(timespec="microseconds").replace("+00:00", "Z")
