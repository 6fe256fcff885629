"""What one C3D file has: the components of a measurement, aligned by the server's time stamps."""

from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np

from gateway.descriptions.force_plates import (
    FORCES_AND_MOMENTS,
    PlateGeometry,
    calibration_of,
    channels_from_loads,
    geometry_of,
    is_equal,
    loads_from_channels,
    moment_factor,
    own_channels,
    possible_types,
)
from gateway.rtc3d.parameters import Parameters, Plate
from gateway.takes.export.job import ExportJob
from gateway.takes.export.measurements import Measurement, Part, Placed, place, seconds_of_row
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


def residual_step(blocks: Iterable[Array]) -> float:
    """Return the step of residuals, in the unit of the points, for markers of shape (frames, markers, 4).

    A residual has 7 bits. The step is the smallest residual if all are multiples of it, and thus exact.
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
        return 1.0
    multiples = different.astype(np.float64) / different[0]  # a damaged one may be 1e-40
    is_exact = is_exact and multiples[-1] <= _MAX_STEPS + 0.5
    is_exact = is_exact and bool(np.allclose(multiples, np.round(multiples), rtol=1e-5))
    return float(different[0] if is_exact else different[-1] / np.float32(_MAX_STEPS))


_COMPARED_BLOCKS: Final = 20
_COMPARED_ROWS: Final = 1000  # of each block
_FIRST_MOMENT: Final = 3


class PlatePlan(NamedTuple):
    """How one plate is written. ``channels`` are indices of analog channels.

    If ``is_added``, these six channels follow the server's own, and are computed from the Force component.
    ``position`` is the index of the plate in it.
    """

    position: int
    plate: Plate
    geometry: PlateGeometry
    type: int
    channels: tuple[int, ...]
    is_added: bool
    moment_factor: float

    def explains(self, channels: Array, loads: Array) -> bool:
        """Whether readers compute the recorded loads from the plate's own channels.

        The server's loads may have the axes of the laboratory or those of the plate.
        """
        own_axes = self.geometry._replace(rotation=np.eye(3), origin=np.zeros(3))
        calibration, recorded = calibration_of(self.plate), self.loads_of(loads)
        return any(
            is_equal(loads_from_channels(self.type, channels, calibration, geometry), recorded)
            for geometry in (self.geometry, own_axes)
        )

    def loads_of(self, loads: Array) -> Array:
        """Return the plate's loads, shape (samples, 6), of Force items, shape (samples, plates, 6)."""
        return loads[:, self.position].astype(np.float64) * ([1.0] * 3 + [self.moment_factor] * 3)


def plan_plates(
    job: ExportJob, parameters: Parameters, unit: str, analog: Placed | None, forces: Placed | None
) -> list[PlatePlan]:
    """Return how each plate is written; plates that cannot be written are reported.

    ``analog`` and ``forces`` have the same rate. ``unit`` is that of the points.
    """
    plans: list[PlatePlan] = []
    num_channels = 0 if analog is None else analog.num_items
    plates = parameters.force.plates if parameters.force else ()
    unknown = 0 if forces is None else forces.num_items - len(plates)
    if unknown > 0:
        job.note(
            f"forces of plates without parameters were left out: {unknown}, because their corners are not "
            "known; export to .csv has them"
        )
    for index, plate in enumerate(plates[:MAX_LIST]):
        name = f"force plate {index + 1}" + (f" ({plate.label})" if plate.label else "")
        geometry = geometry_of(plate, unit)
        if geometry is None:
            job.note(f"{name} was left out: its parameters do not give the corners of a rectangle")
            continue
        moments = plate.channels[_FIRST_MOMENT:][:1]
        factor = moment_factor(moments[0].unit if moments else "", unit)
        plan = PlatePlan(index, plate, geometry, FORCES_AND_MOMENTS, (), False, factor)
        own = _with_own_channels(plan, parameters, analog, forces)
        if own is not None:
            plans.append(own)
        elif forces is not None and index < forces.num_items:
            channels = tuple(range(num_channels, num_channels + 6))
            plans.append(plan._replace(channels=channels, is_added=True))
            num_channels += 6
        else:
            job.note(f"{name} was left out: the take has neither its analog channels nor its forces")
    return plans


def _with_own_channels(
    plan: PlatePlan, parameters: Parameters, analog: Placed | None, forces: Placed | None
) -> PlatePlan | None:
    """Return the plan with the server's own channels; None if the recorded loads do not follow from them.

    Values of the same times are compared, from the whole measurement.
    """
    channels = own_channels(plan.plate, parameters.analog)
    if analog is None or not channels or max(channels) >= analog.num_items:
        return None
    plans = [
        plan._replace(type=plate_type, channels=channels)
        for plate_type in possible_types(plan.plate, len(channels))
    ]
    if forces is None or plan.position >= forces.num_items:
        return next(iter(plans), None)
    first, last = max(analog.first_row, forces.first_row), min(analog.last_row, forces.last_row)
    latest = max(first, last - _COMPARED_ROWS + 1)
    starts = np.unique(np.linspace(first, latest, _COMPARED_BLOCKS).astype(int)).tolist()
    values, loads = (
        np.concatenate([placed.block(start, start + _COMPARED_ROWS) for start in starts])
        for placed in (analog, forces)
    )
    known = np.isfinite(values).all(axis=1) & np.isfinite(loads).all(axis=(1, 2))
    values = values[known][:, channels].astype(np.float64)
    return next((own for own in plans if not known.any() or own.explains(values, loads[known])), None)


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
        return np.concatenate(parts, axis=1, dtype=np.float32)


def content_of(job: ExportJob, measurement: Measurement) -> C3dContent:
    """Choose and align the components of a measurement."""
    base = measurement.frames
    markers = base if base.series.key == "3d" else None
    analog, samples = _sampled(job, measurement, "analog", None)
    forces, samples = _sampled(job, measurement, "force", samples)
    samples = samples or 1
    sampled, first, stop = analog or forces, 0, measurement.grid.num_rows
    if sampled is not None:
        most = _MAX_TRIMMED_S * measurement.grid.rate_hz
        first_complete, stop_complete = -(-sampled.first_row // samples), (sampled.last_row + 1) // samples
        first = first_complete if first_complete <= most else first
        stop = stop_complete if stop - stop_complete <= most else stop
        if first >= stop:
            first, stop = 0, measurement.grid.num_rows
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
