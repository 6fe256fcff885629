"""The force plates of a measurement in a C3D file: FORCE_PLATFORM, and the channels that it needs."""

from typing import Any, Final, NamedTuple

import numpy as np

from gateway.descriptions.force_plates import (
    ADDED_LABELS,
    CALIBRATED,
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
from gateway.export.c3d_format import MAX_LIST, Parameter
from gateway.export.job import ExportJob
from gateway.export.measurements import Placed
from gateway.rtc3d.parameters import Parameters, Plate
from gateway.takes.component_rows import Array

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

    def added_labels(self) -> list[str]:
        """Return the labels of the six added channels, such as Fx1."""
        return [f"{label}{self.position + 1}" for label in ADDED_LABELS]

    def added_units(self, position_unit: str) -> list[str]:
        """Return the units of the six added channels."""
        force = self.plate.channels[0].unit if self.plate.channels else ""
        return [force or "N"] * 3 + [(force or "N") + position_unit] * 3

    def added_values(self, loads: Array) -> Array:
        """Return the six added channels, shape (samples, 6), from Force items of shape (samples, plates,
        6)."""
        return channels_from_loads(self._loads(loads), self.geometry)

    def explains(self, channels: Array, loads: Array) -> bool:
        """Whether readers compute the recorded loads from the plate's own channels.

        The server's loads may have the axes of the laboratory or those of the plate.
        """
        calibration = calibration_of(self.plate)
        computed = loads_from_channels(self.type, channels, calibration, self.geometry)
        recorded = self._loads(loads)
        if is_equal(computed, recorded):
            return True
        own_axes = self.geometry._replace(rotation=np.eye(3), origin=np.zeros(3))
        return is_equal(loads_from_channels(self.type, channels, calibration, own_axes), recorded)

    def _loads(self, loads: Array) -> Array:
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
    """Return the plan with the server's own channels; None if the recorded loads do not follow from them."""
    channels = own_channels(plan.plate, parameters.analog)
    if analog is None or not channels or max(channels) >= analog.num_items:
        return None
    common = None
    if forces is not None and plan.position < forces.num_items:
        common = _common_samples(analog, forces)
    for plate_type in possible_types(plan.plate, len(channels)):
        own = plan._replace(type=plate_type, channels=channels)
        if common is None or own.explains(common[0][:, channels], common[1]):
            return own
    return None


def _common_samples(analog: Placed, forces: Placed) -> tuple[Array, Array] | None:
    """Return analog and force values of the same times, from the whole measurement; None if there are
    none."""
    first, last = max(analog.first_row, forces.first_row), min(analog.last_row, forces.last_row)
    starts = np.unique(
        np.linspace(first, max(first, last - _COMPARED_ROWS + 1), _COMPARED_BLOCKS).astype(int)
    )
    channels = np.concatenate([analog.block(start, start + _COMPARED_ROWS) for start in starts.tolist()])
    loads = np.concatenate([forces.block(start, start + _COMPARED_ROWS) for start in starts.tolist()])
    known = np.isfinite(channels).all(axis=1) & np.isfinite(loads).all(axis=(1, 2))
    return (channels[known].astype(np.float64), loads[known]) if known.any() else None


def plate_group(plans: list[PlatePlan]) -> list[Parameter]:
    """Return the group FORCE_PLATFORM."""
    num_rows = max((len(plan.channels) for plan in plans), default=0)
    channels = [np.array(plan.channels + (-1,) * (num_rows - len(plan.channels))) + 1 for plan in plans]
    units = {plan.plate.channels[0].unit for plan in plans if plan.plate.channels} - {"", "N"}
    matrices = [calibration_of(plan.plate) if plan.type == CALIBRATED else np.zeros((6, 6)) for plan in plans]
    return [
        Parameter("USED", np.array(len(plans), np.int16)),
        Parameter("TYPE", np.array([plan.type for plan in plans], np.int16)),
        Parameter("ZERO", np.zeros(2, np.int16)),
        Parameter("CORNERS", _stack([plan.geometry.corners.T for plan in plans])),
        Parameter("ORIGIN", _stack([plan.geometry.origin for plan in plans])),
        Parameter("CHANNEL", _stack(channels, np.int16)),
        Parameter("CAL_MATRIX", _stack(matrices)),
        *([Parameter("UNITS", [units.pop()])] if len(units) == 1 else []),
    ]


def _stack(arrays: list[Array], dtype: type[np.number[Any]] = np.float32) -> Array:
    """Return arrays along a new last dimension; an empty list if there are none."""
    return np.stack(arrays, axis=-1).astype(dtype) if arrays else np.zeros(0, dtype)
