"""Export to TRC, the format in which OpenSim reads markers."""

from pathlib import Path
from typing import Final

import numpy as np

from gateway.messages.descriptions.labels import printable
from gateway.takes.export.axes import rotation_of
from gateway.takes.export.job import ExportJob
from gateway.takes.export.measurements import (
    ExportedMeasurement,
    named_measurements,
    note_missing,
    seconds_of_row,
    utc_text,
)
from gateway.takes.export.number_text import number_rows, rounded
from gateway.takes.export.opensim_labels import NOT_IN_LABELS, opensim_labels
from gateway.takes.files.component_rows import Array

_KNOWN_UNITS: Final = ("mm", "m")
_BLOCK_ROWS: Final = 500


def export_trc(job: ExportJob) -> None:
    """Write the markers of each measurement of each source to a file of its own, in the server's units.

    They have the server's axes, too, unless ``job`` has axes.
    """
    for measurement, path in named_measurements(job, ("3d",), "markers"):
        rotation = rotation_of(job, measurement, path.name) if job.opensim.has_axes else None
        unit = measurement.base.unit or "mm"
        if unit not in _KNOWN_UNITS:
            job.note(f"the unit is {unit}; OpenSim expects {' or '.join(_KNOWN_UNITS)}", path.name)
        write_trc(job, measurement, path, unit, rotation)


def write_trc(
    job: ExportJob,
    measurement: ExportedMeasurement,
    path: Path,
    unit: str,
    rotation: Array | None,
    factor: float = 1.0,
) -> None:
    """Write the markers of a measurement.

    A line for each frame; a marker that is missing has three empty cells. Each cell ends in a tab: OpenSim
    ignores an empty cell at the end of a line, unless a tab follows. Positions are multiplied by ``factor``,
    so that they have ``unit``, and rotated; without rotation, they are written as they were recorded.
    """
    file = job.files.create(path)
    file.write(_head(job, measurement, path.name, unit).encode())
    frames, grid = measurement.frames, measurement.grid
    start_s = seconds_of_row(measurement, 0)
    for start in range(0, grid.num_rows, _BLOCK_ROWS):
        stop = min(start + _BLOCK_ROWS, grid.num_rows)
        positions = frames.block(start, stop)[..., :3]
        positions[np.isnan(positions).any(axis=2)] = np.nan
        if rotation is not None:
            with np.errstate(invalid="ignore"):  # infinity, which becomes an empty cell
                positions = rounded(positions.astype(np.float64) * factor @ rotation.T)
        cells = number_rows(positions.reshape(stop - start, -1), separator=b"\t")
        times = (start_s + np.arange(start, stop) / grid.rate_hz).tolist()
        lines = zip(range(start + 1, stop + 1), times, cells, strict=True)
        file.write(b"".join(b"%d\t%.6f\t%b\t\n" % line for line in lines))
        job.progress(f"writing {path.name}", stop, grid.num_rows)
    note_missing(job, path, measurement, 0, grid.num_rows)
    job.rows.written[measurement.source.name, "3d"] += frames.count(0, grid.num_rows)


def _head(job: ExportJob, measurement: ExportedMeasurement, name: str, unit: str) -> str:
    """Return the five lines before the frames, and an empty one."""
    grid = measurement.grid
    labels = opensim_labels(job, name, measurement.source.name, measurement.base)
    rate = f"{grid.rate_hz:.10g}"
    values = (rate, rate, grid.num_rows, len(labels), printable(unit), rate, 1, grid.num_rows)
    axes = [f"{axis}{number}" for number in range(1, len(labels) + 1) for axis in "XYZ"]
    lines = [
        # Readers take the rest of the line as the name of the file. They allow no more keys in the next two.
        f"PathFileType\t4\t(X/Y/Z)\t{NOT_IN_LABELS.sub('_', name)} time_0={utc_text(measurement)}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        "\t".join(map(str, values)),
        "Frame#\tTime\t" + "".join(f"{label}\t\t\t" for label in labels),
        "\t\t" + "".join(f"{axis}\t" for axis in axes),
        "",
    ]
    return "\n".join(lines) + "\n"
