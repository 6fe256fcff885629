"""Exporting takes in tests, and reading C3D files by ezc3d and by the independent package ``c3d``."""

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import c3d
import ezc3d
import numpy as np
import numpy.typing as npt

from gateway.export.formats import export_take
from gateway.export.job import ExportJob
from tests.takes import Message, write_take

Values = npt.NDArray[Any]


def export_messages(folder: Path, messages: Iterable[Message], name: str, **options: Any) -> ExportJob:
    """Export a take of these messages to a file of this name in the folder; return the finished job."""
    take = write_take(folder / "take.lcmlog", messages)
    job = ExportJob(take, folder / name, **options)
    export_take(job)
    return job


class IndependentC3d(NamedTuple):
    """What the package ``c3d`` reads from a file.

    ``points`` has the shape (frames, points, 5), ``is_visible`` (frames, points), and ``analog`` (samples,
    channels), all as 32-bit floats.
    """

    point_rate_hz: float
    analog_rate_hz: float
    labels: list[str]
    points: Values
    is_visible: Values
    analog: Values


def read_ezc3d(path: Path) -> Any:
    return ezc3d.c3d(str(path), extract_forceplat_data=True)


def read_independently(path: Path) -> IndependentC3d:
    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about components that the file does not have
        reader = c3d.Reader(file)
        frames = list(reader.read_frames())
        labels = [str(label).strip() for label in reader.point_labels]
    points = np.array([frame[1] for frame in frames], np.float32)
    analog = np.concatenate(
        [frame[2].T for frame in frames]
    )  # of shape (channels, samples); (0,) without any
    return IndependentC3d(
        reader.point_rate, reader.analog_rate, labels, points, points[..., 3] >= 0, analog.astype(np.float32)
    )
