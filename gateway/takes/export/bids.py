"""Export to Motion-BIDS: a folder in which neuroscientists and movement scientists share recordings.

Each component of each source is a tracking system of its own, because it has a rate of its own. Frames are on
a regular grid, as in C3D; all tracking systems of a run have their own time of the first sample in scans.tsv.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from gateway.messages.descriptions.force_plates import placed_plates, units_of
from gateway.messages.descriptions.labels import event_text, fitting_labels, printable
from gateway.messages.encode import metres_per_unit
from gateway.rtc3d.parameters import AnalogChannel, Marker, Tool
from gateway.takes.export.bids_data_set import (
    NOT_AVAILABLE,
    DataSet,
    add_rows,
    bids_label,
    note_label,
    open_data_set,
    write_json,
    write_table,
)
from gateway.takes.export.changed_labels import note_event_labels, note_labels
from gateway.takes.export.job import ExportJob, nothing_to_export
from gateway.takes.export.measurements import (
    ExportedMeasurement,
    check_number,
    event_seconds,
    measurements_by_component,
    note_grid,
    note_missing,
    seconds_of_row,
    utc_text,
)
from gateway.takes.export.number_text import number_rows, rounded
from gateway.takes.export.plates import unit_notes
from gateway.takes.export.source_frame import frame_of, is_of_server
from gateway.takes.files.series import Series
from gateway.takes.files.take import Take, TakeSource

_LABELS: Final = {"3d": "Markers", "6d": "Tools", "analog": "Analog", "force": "Forces"}
"""The components that are exported, and the end of the labels of their tracking systems."""

_POSITION: Final = tuple((axis, axis, "POS") for axis in "xyz")
_FIELDS: Final = {
    "3d": (*_POSITION, ("residual", NOT_AVAILABLE, "MISC")),
    "6d": (
        *((f"quat_{axis}", f"quat_{axis}", "ORNT") for axis in "wxyz"),
        *_POSITION,
        ("error", NOT_AVAILABLE, "MISC"),
    ),
    "analog": (("", NOT_AVAILABLE, "MISC"),),
    "force": tuple((f"{kind}_{axis}", axis, "MISC") for kind in ("force", "moment") for axis in "xyz"),
}
"""The end of the name, the component and the type of the channels of each item."""

_TYPES: Final = ("ACCEL", "ANGACCEL", "GYRO", "JNTANG", "LATENCY", "MAGN", "MISC", "ORNT", "POS", "VEL")
_MAX_NAME_BYTES: Final = 100
_MAX_VALIDATED: Final = 1000
"""The validator compares the first 1000 rows of channels.tsv only, unless it is told to read all."""
_NUM_FORCES: Final = 3
_BLOCK_VALUES: Final = 50_000  # values that become text at once: few MB, which the caches of a CPU hold


class _Recording(NamedTuple):
    """A measurement of one tracking system; the times are in s from the beginning of the take."""

    label: str
    measurement: ExportedMeasurement
    start_s: float

    @property
    def stop_s(self) -> float:
        return self.start_s + self.measurement.grid.num_rows / self.measurement.grid.rate_hz

    def is_of_time_of(self, other: "_Recording") -> bool:
        """Whether the two overlap by half of the shorter one: the ends of others overlap by a jitter."""
        overlap_s = min(self.stop_s, other.stop_s) - max(self.start_s, other.start_s)
        return overlap_s >= min(self.stop_s - self.start_s, other.stop_s - other.start_s) / 2


class _Channel(NamedTuple):
    """A row of channels.tsv; the names of the fields are those of its columns."""

    name: str
    component: str
    type: str
    tracked_point: str
    units: str
    reference_frame: str
    description: str
    sampling_frequency: float


def export_bids(job: ExportJob) -> None:
    """Add the take to a data set, which is created if it does not exist: a run for each measurement."""
    take = job.open_take(job.chosen_format.components)
    runs = _runs(job, take)
    data_set = open_data_set(job, take)
    first_run = job.bids.run if job.bids.run is not None else data_set.next_run()
    scans = []
    for number, run in enumerate(runs, start=first_run):
        for recording in run:
            path = _write_motion(job, data_set, number, recording)
            name = path.relative_to(data_set.folder).as_posix()
            scans.append({"filename": name, "acq_time": utc_text(recording.measurement, recording.start_s)})
    for source in take.sources.values():
        _write_events(job, data_set, source, list(enumerate(runs, start=first_run)))
    # Last: a table must not have files that do not exist.
    add_rows(job, data_set.folder / f"{data_set.prefix}_scans.tsv", "filename", scans)
    if len(runs) > 1:
        job.note(f"there are {len(runs)} measurements, so there are {len(runs)} runs")


def _runs(job: ExportJob, take: Take) -> list[list[_Recording]]:
    """Return the recordings of each run: those of the same time, at most one of each tracking system.

    So what all sources recorded at the same time is one run. If the labels of the markers change while the
    analog channels go on, a new run begins that has no analog channels.
    """
    labels: list[str] = []
    for position, source_name in enumerate(take.sources, start=1):
        label = bids_label(source_name)[:_MAX_NAME_BYTES] or f"source{position}"
        while label in labels:
            label += "2"
        labels.append(label)
        note_label(job, "source", source_name, label)
    found = [
        _Recording(label + _LABELS[measurement.base.key], measurement, seconds_of_row(measurement, 0))
        for label, source in zip(labels, take.sources.values(), strict=True)
        for measurements in measurements_by_component(source, tuple(_LABELS))
        for measurement in measurements
    ]
    if not found:
        raise nothing_to_export(job, "markers, tools, analog channels or forces")
    check_number(job, len(found))
    runs: list[list[_Recording]] = []
    for recording in sorted(found, key=lambda each: each.start_s):
        for run in runs:
            is_new = all(each.label != recording.label for each in run)
            if is_new and any(map(recording.is_of_time_of, run)):
                run.append(recording)
                break
        else:
            runs.append([recording])
    return runs


def _write_motion(job: ExportJob, data_set: DataSet, run: int, recording: _Recording) -> Path:
    """Write the files of a tracking system in one run, and return the path of motion.tsv."""
    measurement = recording.measurement
    series, grid = measurement.base, measurement.grid
    conversions = _conversions(job, series)
    factors = np.array([[factor for _, factor in item] for item in conversions])
    path = data_set.path(recording.label, run, "motion.tsv")
    file, placed = job.files.create(path), measurement.frames
    size = max(1, _BLOCK_VALUES // factors.size)
    for start in range(0, grid.num_rows, size):
        stop = min(start + size, grid.num_rows)
        values = (placed.block(start, stop).reshape(-1, *factors.shape) * factors).reshape(stop - start, -1)
        rows = number_rows(rounded(values), NOT_AVAILABLE.encode(), b"\t")
        file.write(b"\n".join([*rows, b""]))
        job.progress(f"writing {path.name}", stop, grid.num_rows)
    note_grid(job, measurement, path.name)
    note_missing(job, path, measurement, 0, grid.num_rows)
    job.rows.written[measurement.source.name, series.key] += placed.count(0, grid.num_rows)
    channels = _channels(job, measurement, conversions)
    if len(channels) > _MAX_VALIDATED:
        what = f"more than {_MAX_VALIDATED} columns: call the validator with --max-rows -1"
        job.note(what, path.name, len(channels))
    write_table(job, data_set.path(recording.label, run, "channels.tsv"), _Channel._fields, channels)
    sidecar = _sidecar(data_set, recording, channels)
    write_json(job, data_set.path(recording.label, run, "motion.json"), sidecar)
    if series.key == "analog":
        job.note("analog channels have the type MISC: Motion-BIDS has no type for them")
    else:
        frames = {
            "reference_frame": {"Levels": {printable(measurement.source.name): _reference_frame(measurement)}}
        }
        write_json(job, data_set.path(recording.label, run, "channels.json"), frames)
    return path


def _conversions(job: ExportJob, series: Series) -> list[list[tuple[str, float]]]:
    """Return the unit of each field of each item, and the factor that turns the server's values into it."""
    if series.key == "analog":
        return [[(printable(unit), 1.0)] for unit in series.units]
    if series.key == "force":
        job.note("forces and moments have the type MISC: Motion-BIDS has no type for them")
        force = series.parameters_of(0).force
        plates = force.plates[: len(series.labels)] if force else ()
        for note in unit_notes(plates):
            job.note(note)
        units = [units_of(plate) for plate in plates]
        units += [(1.0, 1.0)] * (len(series.labels) - len(units))
        return [[("N", force)] * _NUM_FORCES + [("N.m", moment)] * _NUM_FORCES for force, moment in units]
    unit = series.unit or "mm"
    metres = metres_per_unit(unit)
    if metres is None:
        job.note(f"positions not converted to m: their unit, {unit!r}, is unknown")
    elif metres != 1.0:
        job.note(f"positions converted from {unit} to m")
    length = (printable(unit), 1.0) if metres is None else ("m", metres)
    fields = [("", 1.0) if kind == "ORNT" else length for _, _, kind in _FIELDS[series.key]]
    return [fields] * len(series.labels)


def _channels(
    job: ExportJob, measurement: ExportedMeasurement, conversions: list[list[tuple[str, float]]]
) -> list[_Channel]:
    """Return the rows of channels.tsv."""
    series, fields = measurement.base, _FIELDS[measurement.base.key]
    names = [f"{label}_{end}" if end else label for label in series.labels for end, _, _ in fields]
    fitted = iter(fitting_labels(names, printable, _MAX_NAME_BYTES, "channel"))
    channels = [
        _Channel(
            name=next(fitted),
            component=component,
            type=kind,
            tracked_point="" if series.key == "analog" else printable(label),
            units=unit,
            reference_frame="" if component == NOT_AVAILABLE else printable(measurement.source.name),
            description=printable(description),
            sampling_frequency=measurement.grid.rate_hz,
        )
        for label, description, units in zip(series.labels, _descriptions(series), conversions, strict=True)
        for (_, component, kind), (unit, _) in zip(fields, units, strict=True)
    ]
    end = f"_{fields[0][0]}" if fields[0][0] else ""
    written = [channel.name.removesuffix(end) for channel in channels[:: len(fields)]]
    note_labels(job, measurement.source.name, series, written)
    return channels


def _descriptions(series: Series) -> list[str]:
    """Return the server's description of each item; "" without one."""
    parameters = series.parameters_of(0)
    sections: dict[str, Sequence[Marker | Tool | AnalogChannel]] = {
        "3d": parameters.markers.markers if parameters.markers else (),
        "6d": parameters.tools.tools if parameters.tools else (),
        "analog": parameters.analog.channels if parameters.analog else (),
    }
    texts = [each.description for each in sections.get(series.key, ())[: len(series.labels)]]
    return texts + [""] * (len(series.labels) - len(texts))


def _sidecar(data_set: DataSet, recording: _Recording, channels: list[_Channel]) -> dict[str, Any]:
    """Return the content of motion.json. Keys that BIDS does not have are allowed: Note, ForcePlates."""
    measurement = recording.measurement
    series, grid = measurement.base, measurement.grid
    parameters = series.parameters_of(0)
    counts = Counter(channel.type for channel in channels)
    content: dict[str, Any] = {
        "TaskName": data_set.task,
        "TrackingSystemName": f"{measurement.source.name} {_LABELS[series.key].lower()}",
        "SamplingFrequency": grid.rate_hz,
        "RecordingDuration": grid.num_rows / grid.rate_hz,
        "RecordingType": "continuous",
        "MissingValues": NOT_AVAILABLE,
        "MotionChannelCount": len(channels),
        **{f"{kind}ChannelCount": counts[kind] for kind in _TYPES},
        "TrackedPointsCount": len({channel.tracked_point for channel in channels} - {""}),
    }
    rate_hz = measurement.captured_rate_hz
    if rate_hz is not None:
        content["SamplingFrequencyEffective"] = rate_hz
    if parameters.general:
        content["SoftwareVersions"] = f"{parameters.general.name} {parameters.general.version}".strip()
    if measurement.source.details.note:
        content["Note"] = measurement.source.details.note
    if series.key == "force":
        plates = filter(None, placed_plates(parameters))
        content["ForcePlates"] = [
            {"TrackedPoint": printable(plate.label), "Corners": plate.corners, "Units": "m"}
            for plate in plates
        ]
    return content


def _reference_frame(measurement: ExportedMeasurement) -> dict[str, str]:
    """Return the description of the axes; where they point to is not known."""
    text = f"Origin and axes of the motion-capture server of {measurement.source.name}."
    frame = frame_of(measurement.source)
    if not is_of_server(frame):
        text += (
            f" Their transform to the frame {printable(frame.frame_id)} is not applied: to scale by "
            f"{frame.scale:.9g}, to rotate by the quaternion (x, y, z, w) {_numbers(frame.rotation_xyzw)}, "
            f"and to move by {_numbers(frame.translation_m)} m."
        )
    elif measurement.source.frame:
        text += f" They are the frame {printable(frame.frame_id)}."
    if measurement.base.key == "force":
        text += " Moments are about the centre of the surface of the plate."
    return {"RotationRule": "right-hand", "Description": text}


def _numbers(values: Sequence[float]) -> str:
    return f"({', '.join(f'{value:.9g}' for value in values)})"


_EVENT_COLUMNS: Final = {
    "trial_type": "The label of the event",
    "value": "The number of the event",
    "description": "The parameters of the event",
}


def _write_events(
    job: ExportJob, data_set: DataSet, source: TakeSource, runs: list[tuple[int, list[_Recording]]]
) -> None:
    """Write the events of a source beside its first tracking system in each run, from whose start they count.

    An event belongs to the run that is the nearest one in time.
    """
    events = source.events
    if events is None:
        return
    firsts = [
        (number, min(own, key=lambda each: [*_LABELS].index(each.measurement.base.key)))
        for number, run in runs
        if (own := [each for each in run if each.measurement.source is source])
    ]
    seconds = np.array([event_seconds(each.measurement) for _, each in firsts]).reshape(-1, len(events))
    durations = np.array([[each.stop_s - each.start_s] for _, each in firsts]).reshape(-1, 1)
    outside = np.nan_to_num(np.maximum(np.maximum(-seconds, seconds - durations), 0.0), nan=np.inf)
    belongs = np.isfinite(outside).any(axis=0)
    if not belongs.all():
        job.note(f"events of {source.name} that are of no run left out", amount=int((~belongs).sum()))
    for position, (number, recording) in enumerate(firsts):
        (chosen,) = np.nonzero(belongs & (outside.argmin(axis=0) == position))
        if not len(chosen):
            continue
        rows, labels = [], []
        for row in chosen[np.argsort(seconds[position, chosen], kind="stable")].tolist():
            text = event_text(events.parameters_of(row), events.items[row])
            label, description = printable(text.label), printable(text.description)
            onset = f"{seconds[position, row]:.6f}"
            labels.append((text.label, label))
            rows.append((onset, 0, label, int(events.items[row]["id"]), description))
        note_event_labels(job, source.name, *zip(*labels, strict=True))
        job.rows.written[source.name, "event"] += len(rows)
        columns = ("onset", "duration", *_EVENT_COLUMNS)
        write_table(job, data_set.path(recording.label, number, "events.tsv"), columns, rows)
        described = {name: {"Description": text} for name, text in _EVENT_COLUMNS.items()}
        write_json(job, data_set.path(recording.label, number, "events.json"), described)
