"""What one C3D file has: the components of a measurement, aligned by the server's time stamps."""

from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np

from gateway.messages.descriptions.force_plates import channels_from_loads
from gateway.rtc3d.parameters import Parameters
from gateway.takes.export.job import ExportJob
from gateway.takes.export.measurements import ExportedMeasurement, Placed, sampled, seconds_of_row
from gateway.takes.export.plates import PlatePlan, plan_plates
from gateway.takes.files.component_rows import Array

MAX_LIST: Final = 255
"""The highest number of values in one dimension of a parameter; a longer list continues in others."""

_MAX_STEPS: Final = 127
_BOTH_BYTES: Final = 257
_MISSING: Final = (0.0, 0.0, 0.0, -1.0)


def encode_points(markers: Array, step: float) -> Array:
    """Return the words of points from markers, both of shape (frames, markers, 4).

    A point that is missing is 0, 0, 0, -1. The fourth word of a visible one has two bytes. In c3d.org's guide
    and in NDI's files, the low byte is the residual in steps, and the high byte says which cameras saw the
    marker; ezc3d reads them the other way round. The protocol says nothing about cameras, so both bytes have
    the residual.
    """
    words = markers.copy()
    steps = np.clip(np.round(np.nan_to_num(markers[..., 3]).astype(np.float64) / step), 0, _MAX_STEPS)
    words[..., 3] = steps * _BOTH_BYTES
    words[np.isnan(markers[..., :3]).any(axis=2)] = _MISSING
    return words


def residual_step(blocks: Iterable[Array]) -> tuple[float, bool]:
    """Return the step of residuals, in the unit of the points, and whether all are multiples of it.

    The blocks are markers of shape (frames, markers, 4). A residual has 7 bits. The step is the smallest
    residual if all are multiples of it, and thus exact.
    """
    different: Array = np.empty(0, np.float32)
    is_exact = True
    for markers in blocks:
        visible = ~np.isnan(markers[..., :3]).any(axis=2)
        residuals = markers[..., 3][visible]
        different = np.union1d(different, residuals[np.isfinite(residuals) & (residuals > 0)])
        if len(different) > _MAX_STEPS:
            different, is_exact = different[[0, -1]], False
    if not len(different):
        return 1.0, True
    multiples = different.astype(np.float64) / different[0]  # a damaged one may be 1e-40
    is_exact = is_exact and multiples[-1] <= _MAX_STEPS + 0.5
    is_exact = is_exact and bool(np.allclose(multiples, np.round(multiples), rtol=1e-5))
    return float(different[0] if is_exact else different[-1] / np.float32(_MAX_STEPS)), is_exact


_MAX_TRIMMED_S: Final = 1.0
"""Frames at either end that lack analog samples are left out, up to this duration."""


class C3dContent(NamedTuple):
    """What one file has. ``first_row`` is the row of the measurement that is its first frame."""

    measurement: ExportedMeasurement
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
    def rate_hz(self) -> float:
        """The nearest rate of frames whose product with ``samples_per_frame`` is exact in 32 bits.

        Readers divide ANALOG:RATE by POINT:RATE and need exactly ``samples_per_frame``.
        """
        bits = max(self.samples_per_frame - 1, 0).bit_length()
        mantissa, exponent = np.frexp(np.float32(self.measurement.grid.rate_hz))
        digits = 2.0 ** (24 - bits)
        return float(np.ldexp(np.round(mantissa * digits) / digits, exponent))

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

    @property
    def num_marker_frames(self) -> int:
        """How many recorded frames of markers are in the frames."""
        return (
            0
            if self.markers is None
            else self.markers.count(self.first_row, self.first_row + self.num_frames)
        )

    def num_samples(self, placed: Placed | None) -> int:
        """Return how many recorded samples of a component are in the frames."""
        if placed is None:
            return 0
        first = self.first_row * self.samples_per_frame
        return placed.count(first, first + self.num_frames * self.samples_per_frame)

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
            parts += [channels_from_loads(plan.loads_of(loads), plan.geometry) for plan in self.added_plates]
        with np.errstate(over="ignore"):  # moments in a smaller unit can be beyond float32
            return np.concatenate(parts, axis=1, dtype=np.float32)


def content_of(job: ExportJob, measurement: ExportedMeasurement) -> C3dContent:
    """Choose and align the components of a measurement."""
    base = measurement.frames
    markers = base if base.series.key == "3d" else None
    analog, samples = sampled(job, measurement, "analog", None)
    forces, samples = sampled(job, measurement, "force", samples)
    samples = samples or 1
    timed, first, stop = analog or forces, 0, measurement.grid.num_rows
    if timed is not None:
        most = _MAX_TRIMMED_S * measurement.grid.rate_hz
        first_complete, stop_complete = -(-timed.first_row // samples), (timed.last_row + 1) // samples
        first = first_complete if first_complete <= most else first
        stop = stop_complete if stop - stop_complete <= most else stop
        if first >= stop:
            first, stop = 0, measurement.grid.num_rows
    left_out = measurement.grid.num_rows - (stop - first)
    if left_out:
        job.note("frames at the ends left out, because they have no analog samples", amount=left_out)
    parameters = base.series.parameters_of(0)
    unit = (base.series.unit if markers else parameters.markers and parameters.markers.unit) or "mm"
    plates = plan_plates(job, parameters, unit, analog, forces)
    if plates:  # they have corners, also if nothing else has coordinates
        job.note_frame(measurement.source)
    return C3dContent(
        measurement, parameters, unit, markers, analog, forces, samples, plates, first, stop - first
    )
