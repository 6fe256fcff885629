"""Export to TRC, the format in which OpenSim reads markers."""

import re
from typing import Final

import numpy as np

from gateway.descriptions.labels import fitting_labels
from gateway.takes.export.job import ExportJob
from gateway.takes.export.measurements import (
    Measurement,
    named_measurements,
    note_missing,
    seconds_of_row,
    utc_text,
)

_KNOWN_UNITS: Final = ("mm", "m")
_NOT_IN_LABELS: Final = re.compile(r"[^\w.:+-]+")
_MAX_LABEL_BYTES: Final = 100
_BLOCK_ROWS: Final = 500


def export_trc(job: ExportJob) -> None:
    """Write the markers of each measurement of each source to a file of its own.

    A line for each frame; a marker that is missing has three empty cells. Each cell ends in a tab: OpenSim
    ignores an empty cell at the end of a line, unless a tab follows.
    """
    for measurement, path in named_measurements(job, ("3d",), "markers"):
        file = job.files.create(path)
        file.write(_trc_head(job, measurement, path.name).encode())
        frames, grid = measurement.frames, measurement.grid
        start_s = seconds_of_row(measurement, 0)
        for start in range(0, grid.num_rows, _BLOCK_ROWS):
            stop = min(start + _BLOCK_ROWS, grid.num_rows)
            positions = frames.block(start, stop)[..., :3]
            positions[np.isnan(positions).any(axis=2)] = np.nan
            for row, markers in enumerate(positions, start):
                # The shortest texts that mean the same 32-bit numbers.
                cells = "\t".join(map(str, markers.ravel())).replace("nan", "")
                file.write(f"{row + 1}\t{start_s + row / grid.rate_hz:.6f}\t{cells}\t\n".encode())
            job.progress(f"writing {path.name}", stop, grid.num_rows)
        note_missing(job, path, measurement, 0, grid.num_rows)


def _trc_head(job: ExportJob, measurement: Measurement, name: str) -> str:
    """Return the five lines before the frames, and an empty one."""
    markers, grid = measurement.base, measurement.grid
    labels = fitting_labels(
        markers.labels, lambda label: _NOT_IN_LABELS.sub("_", label.strip()), _MAX_LABEL_BYTES, "marker"
    )
    changed = sum(old != new for old, new in zip(markers.labels, labels, strict=True))
    if changed:
        job.note(f"{changed} labels were changed: OpenSim's labels have no spaces and few special characters")
    unit = markers.unit or "mm"
    if unit not in _KNOWN_UNITS:
        job.note(f"the unit is {unit}; OpenSim expects {' or '.join(_KNOWN_UNITS)}")
    rate = f"{grid.rate_hz:.10g}"
    values = (rate, rate, grid.num_rows, len(labels), unit, rate, 1, grid.num_rows)
    axes = [f"{axis}{number}" for number in range(1, len(labels) + 1) for axis in "XYZ"]
    lines = [
        # Readers take the rest of the line as the name of the file. They allow no more keys in the next two.
        f"PathFileType\t4\t(X/Y/Z)\t{_NOT_IN_LABELS.sub('_', name)} time_0={utc_text(measurement)}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        "\t".join(map(str, values)),
        "Frame#\tTime\t" + "".join(f"{label}\t\t\t" for label in labels),
        "\t\t" + "".join(f"{axis}\t" for axis in axes),
        "",
    ]
    return "\n".join(lines) + "\n"
