"""How each force plate is exported: from which channels or loads readers get what was recorded."""

from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np

from gateway.messages.descriptions.force_plates import (
    FORCES_AND_MOMENTS,
    PlateGeometry,
    calibration_of,
    geometry_of,
    is_equal,
    loads_from_channels,
    moment_factor,
    own_channels,
    possible_types,
    units_of,
    unknown_units,
)
from gateway.rtc3d.parameters import Parameters, Plate
from gateway.takes.export.job import ExportJob
from gateway.takes.export.measurements import Placed
from gateway.takes.files.component_rows import Array

_MAX_PLATES: Final = 255
"""A C3D file has no room for more, and no laboratory has more."""

_COMPARED_BLOCKS: Final = 20
_COMPARED_ROWS: Final = 1000  # of each block


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
            "plates without parameters left out; .csv has their forces",
            amount=unknown,
        )
    for index, plate in enumerate(plates[:_MAX_PLATES]):
        name = f"force plate {index + 1}" + (f" ({plate.label})" if plate.label else "")
        geometry = geometry_of(plate, unit)
        if geometry is None:
            job.note(f"{name} left out: its parameters do not give the corners of a rectangle")
            continue
        factor = moment_factor(plate, unit)
        plan = PlatePlan(index, plate, geometry, FORCES_AND_MOMENTS, (), False, factor)
        own = _with_own_channels(plan, parameters, analog, forces)
        if own is not None:
            plans.append(own)
        elif forces is not None and index < forces.num_items:
            channels = tuple(range(num_channels, num_channels + 6))
            plans.append(plan._replace(channels=channels, is_added=True))
            num_channels += 6
        else:
            job.note(f"{name} left out: neither its analog channels nor its forces are there at this rate")
    return plans


def unit_notes(plates: Iterable[Plate], moment_unit: str = "N.m") -> list[str]:
    """Return what has to be reported about the units of plates whose loads become N and N.m.

    ``moment_unit`` is what unknown moments count as.
    """
    plates = [*plates]
    notes = []
    if any(units_of(plate) != (1.0, 1.0) for plate in plates):
        notes.append("forces and moments converted to N and N.m")
    unknown = dict.fromkeys(unit for plate in plates for unit in unknown_units(plate))
    if unknown:
        notes.append(f"unknown units of plates, {', '.join(unknown)}, count as N and {moment_unit}")
    return notes


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
