"""Export for OpenSim: markers (.trc), ground reactions (.mot, .xml) and analog channels (.sto).

Everything is in metres, newtons and Nm, with Y up, as OpenSim's models are. The forces are those on the
person. They come from what readers of C3D would compute for the same take: see ``plates``.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle, islice
from pathlib import Path
from typing import Final, NamedTuple
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from gateway.errors import SelectionError
from gateway.messages.descriptions.force_plates import (
    MIN_FORCE_N,
    GroundReactions,
    calibration_of,
    ground_reactions,
    loads_from_channels,
    units_of,
)
from gateway.messages.descriptions.labels import printable
from gateway.messages.encode import metres_per_unit
from gateway.takes.export.axes import rotation_of
from gateway.takes.export.job import ExportJob, nothing_to_export
from gateway.takes.export.measurements import (
    ExportedMeasurement,
    Placed,
    named_measurements,
    sampled,
    seconds_of_row,
    utc_text,
)
from gateway.takes.export.number_text import number_rows, rounded
from gateway.takes.export.opensim_labels import opensim_labels
from gateway.takes.export.plates import PlatePlan, plan_plates, unit_notes
from gateway.takes.export.trc import write_trc
from gateway.takes.files.component_rows import Array
from gateway.takes.files.reader import SUFFIX

_BLOCK_ROWS: Final = 4000


def export_opensim(job: ExportJob) -> None:
    """Write each measurement of each source to files in a folder, which is created if it does not exist."""
    job.files.create_folder(job.out)
    # The names are in XML, too, which has no place for bytes that are not UTF-8.
    name = printable(job.take.absolute().name.removesuffix(SUFFIX)) or "take"
    job = replace(job, out=job.out / f"{name}.trc")
    keys, what = ("3d", "analog", "force"), "markers, analog channels or forces"
    for measurement, path in named_measurements(job, keys, what):
        has_markers = measurement.base.key == "3d"
        analog = _Samples.of(job, measurement, "analog")
        forces = _Samples.of(job, measurement, "force")
        loads = _PlateLoads.of(job, measurement, analog, forces)
        mot = path.with_suffix(".mot")
        rotated = [each.name for each, exists in ((path, has_markers), (mot, loads)) if exists]
        rotation = rotation_of(job, measurement, ", ".join(rotated)) if rotated else np.eye(3)
        bodies = () if loads is None else _bodies(job, mot, loads.plans)
        if has_markers:
            unit = measurement.base.unit or "mm"
            metres = _metres(job, unit)
            if metres != 1.0:
                job.note(f"positions converted from {unit} to m", path.name)
            write_trc(job, measurement, path, "m", rotation, metres)
        if loads is not None:
            _write_mot(job, mot, loads, rotation)
            _write_external_loads(job, mot, loads.plans, bodies)
        if analog is not None:
            _write_sto(job, path.with_suffix(".sto"), analog)


def export_mot(job: ExportJob) -> None:
    """Write the ground reactions of each measurement of each source to a file of its own."""
    for measurement, path in named_measurements(job, ("force", "analog"), "forces"):
        forces = _Samples.of(job, measurement, "force")
        # Not an error if the channels have another rate: the forces do without them.
        analog = _Samples.of(replace(job, notes=[]), measurement, "analog")
        loads = _PlateLoads.of(job, measurement, analog, forces)
        if loads is not None:
            _write_mot(job, path, loads, rotation_of(job, measurement, path.name))
    if not job.files.paths:
        raise nothing_to_export(job, "forces on plates whose corners are known")


def export_sto(job: ExportJob) -> None:
    """Write the analog channels of each measurement of each source to a file of its own."""
    for measurement, path in named_measurements(job, ("analog",), "analog channels"):
        analog = _Samples.of(job, measurement, "analog")
        if analog is not None:
            _write_sto(job, path, analog)


def _metres(job: ExportJob, unit: str) -> float:
    """Return the length of a unit in metres; an unknown one is reported, and counts as mm."""
    metres = metres_per_unit(unit)
    if metres is None:
        job.note(f"the unit of length is {unit!r}, which is unknown; it counts as mm")
    return metres or 1e-3


class _Samples(NamedTuple):
    """A component of a measurement, with ``per_frame`` samples in each row of the measurement."""

    measurement: ExportedMeasurement
    placed: Placed
    per_frame: int

    @classmethod
    def of(cls, job: ExportJob, measurement: ExportedMeasurement, key: str) -> "_Samples | None":
        """Return a component; None if there is none, or if it is left out, which is reported."""
        placed, per_frame = sampled(job, measurement, key, None)
        return None if placed is None or per_frame is None else cls(measurement, placed, per_frame)

    def blocks(self, progress: Callable[[int, int], None]) -> Iterator[tuple[int, int, Array]]:
        """Yield the first row and the end of parts of the samples, and their times in s.

        ``progress`` is called with the number of rows that are done, and that of all.
        """
        start_s = seconds_of_row(self.measurement, 0)
        rate_hz = self.measurement.grid.rate_hz * self.per_frame
        first, end = self.placed.first_row, self.placed.last_row + 1
        for start in range(first, end, _BLOCK_ROWS):
            stop = min(start + _BLOCK_ROWS, end)
            yield start, stop, start_s + np.arange(start, stop) / rate_hz
            progress(stop - first, end - first)


class _PlateLoads(NamedTuple):
    """The loads on the plates of a measurement, with the component that has them: forces, or channels.

    ``metres`` is the unit of length.
    """

    plates: list[tuple[PlatePlan, Placed]]
    samples: _Samples
    metres: float

    @classmethod
    def of(
        cls,
        job: ExportJob,
        measurement: ExportedMeasurement,
        analog: _Samples | None,
        forces: _Samples | None,
    ) -> "_PlateLoads | None":
        """Return the loads; None if there are none. Plates that are left out are reported."""
        samples = forces or analog
        if samples is None:
            return None
        parameters = measurement.base.parameters_of(0)
        unit = (parameters.markers and parameters.markers.unit) or "mm"
        has_channels = analog is not None and analog.per_frame == samples.per_frame
        channels = analog.placed if analog is not None and has_channels else None
        recorded = None if forces is None else forces.placed
        plans = plan_plates(job, parameters, unit, channels, recorded)
        by_plan = ((plan, recorded if plan.is_added else channels) for plan in plans)
        plates = [(plan, placed) for plan, placed in by_plan if placed is not None]
        if not plates:
            return None
        job.note_frame(measurement.source)  # the forces may come from channels, which have none themselves
        for note in unit_notes((plan.plate for plan, _ in plates), f"N.{unit}"):
            job.note(note)
        return cls(plates, samples, _metres(job, unit))

    @property
    def plans(self) -> list[PlatePlan]:
        """The plates."""
        return [plan for plan, _ in self.plates]

    def blocks(
        self, min_force_n: float, contacts: Sequence[Array] | None, progress: Callable[[int, int], None]
    ) -> Iterator[tuple[Array, list[GroundReactions]]]:
        """Yield parts of the samples of which all loads are known: their times, and each plate's reactions.

        ``contacts`` say for each plate which of these samples may be contact; None means all. The reactions
        have the server's axes.
        """
        done = 0
        for start, stop, times in self.samples.blocks(progress):
            with np.errstate(invalid="ignore"):  # any bits that are a NaN, and infinity
                loads = [self._newtons(plan, placed.block(start, stop)) for plan, placed in self.plates]
            is_known = np.logical_and.reduce([np.isfinite(each).all(axis=1) for each in loads])
            end = done + int(np.count_nonzero(is_known))
            found = []
            for index, plan in enumerate(self.plans):
                known = loads[index][is_known]
                if contacts is not None:
                    known[~contacts[index][done:end]] = 0.0
                centre = plan.geometry.corners.mean(axis=0) * self.metres
                found.append(ground_reactions(known, plan.geometry.rotation[:, 2], centre, min_force_n))
            yield times[is_known], found
            done = end

    def _newtons(self, plan: PlatePlan, values: Array) -> Array:
        """Return the loads on a plate in N and Nm."""
        newtons, _ = units_of(plan.plate)
        loads: Array = _loads_of(plan, values) * newtons * ([1.0] * 3 + [self.metres] * 3)
        return loads


def _loads_of(plan: PlatePlan, values: Array) -> Array:
    """Return the loads on a plate in its own units, of its forces or of analog channels."""
    if plan.is_added:
        return plan.loads_of(values)
    channels = values[:, plan.channels].astype(np.float64)
    return loads_from_channels(plan.type, channels, calibration_of(plan.plate), plan.geometry)


_VERTICAL: Final = 0.7
"""The cosine from which the force on a plate shows whether it is that on the plate or on the person."""


def _write_mot(job: ExportJob, path: Path, loads: _PlateLoads, rotation: Array) -> None:
    """Write forces, centres of pressure and free moments of all plates."""
    chosen_n = job.opensim.min_force_n
    min_force_n = MIN_FORCE_N if chosen_n is None else chosen_n
    signs, contacts = _contacts(job, path, loads, rotation, min_force_n)

    def blocks() -> Iterator[tuple[Array, Array]]:
        progress = partial(job.progress, f"writing {path.name}")
        for times, found in loads.blocks(min_force_n, contacts, progress):
            vectors = [
                vector @ rotation.T
                for reactions, sign in zip(found, signs, strict=True)
                for vector in (sign * reactions.forces, reactions.positions, sign * reactions.free_moments)
            ]
            yield times, rounded(np.concatenate(vectors, axis=1))

    names = [f"{name}{axis}" for plan in loads.plans for name in _identifiers(plan) for axis in "xyz"]
    num_rows = _write_table(job, path, loads.samples, names, "", blocks())
    if loads.samples.placed.series.key == "force":  # and not the plates' channels
        job.rows.written[loads.samples.measurement.source.name, "force"] += num_rows


def _identifiers(plan: PlatePlan) -> tuple[str, str, str]:
    """Return how the columns of force, position and moment of a plate begin."""
    number = plan.position + 1
    return f"ground_force_{number}_v", f"ground_force_{number}_p", f"ground_torque_{number}_"


_MIN_CONTACT_S: Final = 0.01
"""A shorter contact is a disturbance: a foot stays on a plate for some 100 ms, and a blow for some 10 ms."""


def _contacts(
    job: ExportJob, path: Path, loads: _PlateLoads, rotation: Array, min_force_n: float
) -> tuple[list[float], list[Array]]:
    """Return -1 for each plate whose loads are those on the plate, 1 for those on the person.

    Also return for each plate which of the samples whose loads are known are contact. Nothing can pull at a
    plate, so contact has the sign along the normal that strong forces have. The force on a person points up.
    Cubes are summed, so that steps decide, and not hours of the small force that an empty plate shows.
    """
    sums, normal_sums = np.zeros(len(loads.plans)), np.zeros(len(loads.plans))
    normal_signs: list[list[Array]] = [[] for _ in loads.plans]
    progress = partial(job.progress, f"reading the forces of {path.name}")
    for _, found in loads.blocks(min_force_n, None, progress):
        for index, reactions in enumerate(found):
            sums[index] += ((reactions.forces @ rotation[1]) ** 3).sum()
            normal_forces = reactions.forces @ loads.plans[index].geometry.rotation[:, 2]
            normal_sums[index] += (normal_forces**3).sum()
            normal_signs[index].append(np.sign(normal_forces).astype(np.int8))
    rate_hz = loads.samples.measurement.grid.rate_hz * loads.samples.per_frame
    min_samples = round(_MIN_CONTACT_S * rate_hz)
    signs, contacts = [], []
    for index, plan in enumerate(loads.plans):
        is_vertical = abs(float(plan.geometry.rotation[:, 2] @ rotation[1])) > _VERTICAL
        signs.append(-1.0 if is_vertical and sums[index] < 0 else 1.0)
        name = f"plate {plan.position + 1}"
        if signs[-1] < 0:
            job.note(f"{name}: forces reversed, because those on the plate were recorded", path.name)
        is_pressed = np.concatenate(normal_signs[index]) == (-1 if normal_sums[index] < 0 else 1)
        contact = _without_short(is_pressed, min_samples)
        contacts.append(contact)
        job.note(
            f"{name}: no contact below {min_force_n:g} N or for less than {1000 * _MIN_CONTACT_S:g} ms: "
            "force and moment are 0",
            path.name,
            f"{len(contact) - np.count_nonzero(contact)} of {len(contact)} samples",
        )
    return signs, contacts


def _without_short(flags: Array, min_samples: int) -> Array:
    """Return flags without the rows of neighbours that are shorter."""
    starts, stops = np.flatnonzero(np.diff(flags, prepend=False, append=False)).reshape(-1, 2).T
    is_long = stops - starts >= min_samples
    steps = np.zeros(len(flags) + 1, np.int8)
    steps[starts[is_long]] = 1
    steps[stops[is_long]] = -1
    kept: Array = np.cumsum(steps[:-1], dtype=np.int8) > 0
    return kept


def _write_sto(job: ExportJob, path: Path, analog: _Samples) -> None:
    """Write the values of all channels as they were recorded."""
    series = analog.placed.series

    def blocks() -> Iterator[tuple[Array, Array]]:
        for start, stop, times in analog.blocks(partial(job.progress, f"writing {path.name}")):
            values = analog.placed.block(start, stop)
            is_known = ~np.isnan(values).all(axis=1)
            yield times[is_known], values[is_known]

    units = printable(series.unit or ",".join(series.units))
    labels = opensim_labels(job, path.name, analog.measurement.source.name, series)
    num_rows = _write_table(job, path, analog, labels, f"units={units}\n", blocks())
    job.rows.written[analog.measurement.source.name, "analog"] += num_rows


_COUNT_WIDTH: Final = 12


def _write_table(
    job: ExportJob,
    path: Path,
    samples: _Samples,
    labels: Sequence[str],
    more: str,
    blocks: Iterable[tuple[Array, Array]],
) -> int:
    """Write a file of OpenSim's Storage from blocks of times and values, shape (rows, labels).

    Return the number of rows. The times say where rows are missing. ``more`` are lines of the header.
    """
    file = job.files.create(path)
    file.write(f"{printable(path.stem)}\nversion=1\nnRows=".encode())
    place_of_count = file.tell()
    file.write(b" " * _COUNT_WIDTH)
    time_0 = utc_text(samples.measurement)
    file.write(f"\nnColumns={len(labels) + 1}\ninDegrees=no\ntime_0={time_0}\n{more}endheader\n".encode())
    file.write(("\t".join(["time", *labels]) + "\n").encode())
    num_rows, num_expected = 0, samples.placed.last_row - samples.placed.first_row + 1
    for times, values in blocks:
        rows = zip(times.tolist(), number_rows(values, b"nan", b"\t"), strict=True)
        file.write(b"".join(b"%.6f\t%b\n" % row for row in rows))
        num_rows += len(times)
    file.seek(place_of_count)
    file.write(b"%-*d" % (_COUNT_WIDTH, num_rows))
    if num_rows < num_expected:
        job.note(
            "rows without a value in the take left out",
            path.name,
            f"{num_expected - num_rows} of {num_expected}",
        )
    return num_rows


_FEET: Final = ("calcn_r", "calcn_l")


def _bodies(job: ExportJob, mot: Path, plans: list[PlatePlan]) -> tuple[str, ...]:
    """Return the body on which the force of each plate acts. Raises SelectionError unless each has one."""
    bodies = job.opensim.bodies
    if bodies and len(bodies) != len(plans):
        raise SelectionError(
            f"--bodies must have a name for each plate in {mot.name}: {len(plans)}, not {len(bodies)}"
        )
    if not bodies:
        bodies = tuple(islice(cycle(_FEET), len(plans)))
        job.note(
            f"which foot is on which plate is a guess: {', '.join(bodies)}; choose with --bodies",
            mot.with_suffix(".xml").name,
            len(bodies),
        )
    return bodies


def _write_external_loads(job: ExportJob, mot: Path, plans: list[PlatePlan], bodies: tuple[str, ...]) -> None:
    """Write the file that tells OpenSim on which bodies the forces of ``mot`` act."""
    forces = []
    for plan, body in zip(plans, bodies, strict=True):
        force, point, torque = _identifiers(plan)
        forces.append(
            f"""\
      <ExternalForce name="plate_{plan.position + 1}">
        <applied_to_body>{escape(body)}</applied_to_body>
        <force_expressed_in_body>ground</force_expressed_in_body>
        <point_expressed_in_body>ground</point_expressed_in_body>
        <force_identifier>{force}</force_identifier>
        <point_identifier>{point}</point_identifier>
        <torque_identifier>{torque}</torque_identifier>
        <data_source_name>{escape(mot.name)}</data_source_name>
      </ExternalForce>
"""
        )
    text = f"""\
<?xml version="1.0" encoding="UTF-8"?>
<OpenSimDocument Version="40000">
  <ExternalLoads name={quoteattr(mot.stem)}>
    <objects>
{"".join(forces)}\
    </objects>
    <datafile>{escape(mot.name)}</datafile>
  </ExternalLoads>
</OpenSimDocument>
"""
    job.files.create(mot.with_suffix(".xml")).write(text.encode())
