"""The axes of files for OpenSim: Y points up and X forward, whatever the axes of the server."""

from typing import Final, get_args

import numpy as np

from gateway.errors import SelectionError
from gateway.messages.descriptions.force_plates import up_axis_of
from gateway.takes.export.job import Axis, ExportJob
from gateway.takes.export.measurements import ExportedMeasurement
from gateway.takes.files.component_rows import Array

_DEFAULT_UP: Final[Axis] = "z"


def rotation_of(job: ExportJob, measurement: ExportedMeasurement, file: str) -> Array:
    """Return the rotation of the server's axes to those of OpenSim, shape (3, 3), and report it.

    The axis that points up is that of ``job``, or else that of the force plates, or else z; the one that
    becomes X is that of ``job``, or else x (z if x points up). Raises SelectionError if they are the same.
    """
    up, forward = job.opensim.up, job.opensim.forward
    reason = ""
    if up is None:
        up = up_axis_of(entry.parameters for entry in measurement.source.parameters)
        reason = f"; {up} is up by the plates"
    if up is None:
        up, reason = _DEFAULT_UP, f"; that {_DEFAULT_UP} is up is a guess"
    if forward is None:
        forward = "z" if up.endswith("x") else "x"
    if up[-1] == forward[-1]:
        raise SelectionError(f"{up} points up, so --forward cannot be {forward}; choose another axis")
    vectors = {name: _vector(name) for name in get_args(Axis)}
    right = np.cross(vectors[forward], vectors[up])
    side = next(name for name, vector in vectors.items() if np.array_equal(vector, right))
    job.note(f"axes rotated: X is {forward}, Y is {up}, Z is {side} of the server{reason}", file)
    return np.stack([vectors[forward], vectors[up], right])


def _vector(axis: Axis) -> Array:
    vector = np.zeros(3)
    vector["xyz".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    return vector
