"""What one C3D file has: the components of a measurement, aligned by the server's time stamps."""

from typing import Final, NamedTuple

import numpy as np

from gateway.export.c3d_plates import PlatePlan, plan_plates
from gateway.export.frame_grid import place
from gateway.export.job import ExportJob
from gateway.export.measurements import Measurement, Part, Placed
from gateway.export.take_time import seconds_of_row
from gateway.rtc3d.parameters import Parameters
from gateway.takes.component_rows import Array

_MAX_TRIMMED_S: Final = 1.0
"""Frames at either end that lack analog samples are left out, up to this duration."""

_RATIO_TOLERANCE: Final = 0.02


class C3dContent(NamedTuple):
    """What one file has. ``first_row`` is the row of the measurement that is its first frame."""

    measurement: Measurement
    parameters: Parameters
    unit: str
    markers: Placed | None
    analog: Placed | None
    forces: Placed | None
    samples_per_frame: int
    plates: list[PlatePlan]
    first_row: int
    num_frames: int

    @property
    def start_s(self) -> float:
        """When the first frame was captured, in seconds since the beginning of the take."""
        return seconds_of_row(self.measurement, self.first_row)

    @property
    def num_points(self) -> int:
        """The number of markers."""
        return 0 if self.markers is None else self.markers.num_items

    @property
    def num_channels(self) -> int:
        """The number of analog channels, with those that were added."""
        return (0 if self.analog is None else self.analog.num_items) + 6 * len(self.added_plates)

    @property
    def added_plates(self) -> list[PlatePlan]:
        """The plates whose channels follow the server's own analog channels."""
        return [plan for plan in self.plates if plan.is_added]

    def points(self, start: int, stop: int) -> Array:
        """Return the markers of frames, shape (frames, markers, 4)."""
        if self.markers is None:
            return np.empty((stop - start, 0, 4), np.float32)
        return self.markers.block(self.first_row + start, self.first_row + stop)

    def channels(self, start: int, stop: int) -> Array:
        """Return all analog channels of frames, shape (frames · samples_per_frame, channels)."""
        first = (self.first_row + start) * self.samples_per_frame
        last = (self.first_row + stop) * self.samples_per_frame
        parts = [np.empty((last - first, 0), np.float32)]
        if self.analog is not None:
            parts.append(self.analog.block(first, last))
        if self.forces is not None and self.added_plates:
            loads = self.forces.block(first, last)
            parts += [plan.added_values(loads) for plan in self.added_plates]
        return np.concatenate(parts, axis=1, dtype=np.float32)


def content_of(job: ExportJob, measurement: Measurement) -> C3dContent:
    """Choose and align the components of a measurement."""
    base = measurement.frames
    markers = base if base.series.key == "3d" else None
    analog, samples = _sampled(job, measurement, "analog", None)
    forces, samples = _sampled(job, measurement, "force", samples)
    samples = samples or 1
    first, stop = _complete_rows(measurement, analog or forces, samples)
    left_out = measurement.grid.num_rows - (stop - first)
    if left_out:
        job.note(f"frames at the ends were left out because they have no analog samples: {left_out}")
    parameters = base.series.parameters_of(0)
    unit = (base.series.unit if markers else parameters.markers and parameters.markers.unit) or "mm"
    plates = plan_plates(job, parameters, unit, analog, forces)
    return C3dContent(
        measurement, parameters, unit, markers, analog, forces, samples, plates, first, stop - first
    )


def _sampled(
    job: ExportJob, measurement: Measurement, key: str, samples: int | None
) -> tuple[Placed | None, int | None]:
    """Return a component, and its number of samples in each frame, which must be ``samples`` if given."""
    found: dict[tuple[int, tuple[str, ...]], list[Part]] = {}
    for run in measurement.runs_of(key):
        ratio = place(run)[0].rate_hz / measurement.grid.rate_hz
        count = round(ratio)
        fits = count >= 1 and abs(ratio - count) <= _RATIO_TOLERANCE * count and count == (samples or count)
        parts = measurement.parts(run, max(count, 1))
        if parts and fits:
            found.setdefault((count, run.labels), []).extend(parts)
        elif parts:
            wanted = "that of the analog channels" if samples else "a multiple of that of the frames"
            job.note(f"{key} was left out: in C3D, its rate must be {wanted}; export to .csv has it")
    if not found:
        return None, samples
    chosen = max(found, key=lambda identity: sum(len(part.rows) for part in found[identity]))
    if len(found) > 1:
        job.note(f"{key}: a part with other labels or another rate was left out; export to .csv has it")
    return Placed(found[chosen]), chosen[0]


def _complete_rows(measurement: Measurement, analog: Placed | None, samples: int) -> tuple[int, int]:
    """Return the rows without those at the ends that lack analog samples, if these are at most 1 s."""
    stop = measurement.grid.num_rows
    if analog is None:
        return 0, stop
    most = _MAX_TRIMMED_S * measurement.grid.rate_hz
    first_complete = -(-analog.first_row // samples)
    stop_complete = (analog.last_row + 1) // samples
    first = first_complete if first_complete <= most else 0
    stop = stop_complete if stop - stop_complete <= most else stop
    return (first, stop) if first < stop else (0, measurement.grid.num_rows)
