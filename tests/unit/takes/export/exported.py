"""Exporting takes in tests, and reading C3D files by ezc3d and by the independent package ``c3d``."""

import math
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import c3d
import ezc3d
import numpy as np
import numpy.typing as npt

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Marker, Parameters, Parameters3D
from gateway.simulator.synthetic import SyntheticScene
from gateway.takes.export.job import ExportJob, export_take
from tests.support.takes import Message, parameters, scene_messages, write_take

Values = npt.NDArray[Any]

NAN = math.nan
SCENE = SyntheticScene(markers=5, tools=0, analog=3, plates=2, rate_hz=100, analog_rate_hz=1000, seed=5)


def scene(count: int, shown: SyntheticScene = SCENE, **options: Any) -> list[Message]:
    """Return so many frames of a scene after its parameters."""
    return [parameters(shown.parameters), *scene_messages(shown, count, **options)]


def samples(first: int, last: int, shown: SyntheticScene = SCENE) -> Values:
    """Return analog samples of a scene, of shape (channels, samples)."""
    return shown.items(ComponentType.ANALOG, np.arange(first, last)).T


def float32(values: Any) -> Any:
    return np.asarray(values).astype(np.float32)


def labelled(*labels: str, unit: str = "mm", version: int = 1) -> Message:
    markers = tuple(Marker(str(n), label) for n, label in enumerate(labels))
    return parameters(Parameters(markers=Parameters3D(100.0, unit, markers)), version)


def export_messages(folder: Path, messages: Iterable[Message], name: str, **options: Any) -> ExportJob:
    """Export a take of these messages to a file of this name in the folder; return the finished job."""
    take = write_take(folder / "take.lcmlog", messages)
    job = ExportJob(take, folder / name, **options)
    export_take(job)
    return job


def read_ezc3d(path: Path) -> Any:
    return ezc3d.c3d(str(path), extract_forceplat_data=True)


class C3d:
    """What ezc3d reads from a file.

    ``points`` has the shape (4, points, frames), ``residuals`` (points, frames), and ``analog`` (channels,
    samples).
    """

    def __init__(self, path: Path) -> None:
        content = read_ezc3d(path)
        self._parameters = content["parameters"]
        data = content["data"]
        self.points = float32(data["points"])
        self.residuals = data["meta_points"]["residuals"][0]
        self.analog = float32(data["analogs"][0])
        self.plates = data["platform"]

    def __call__(self, group: str, name: str) -> Any:
        """Return a parameter: a list of texts, or an array of numbers; [] without it."""
        return self._parameters[group].get(name, {"value": []})["value"]


def export_c3d(folder: Path, messages: Iterable[Message], **options: Any) -> tuple[C3d, list[str]]:
    """Export to out.c3d; return what ezc3d reads, and the notes of the export."""
    job = export_messages(folder, messages, "out.c3d", **options)
    return C3d(folder / "out.c3d"), notes_of(job)


USUAL_NOTES = (
    "left out of ",
    "times of capture and frame numbers replaced by a regular grid",
    "positions converted from ",
    "labels of tools of ",
    "labels of channels of ",
    "labels of plates of ",
    "residuals rounded to 127 steps",
    "moments converted to Nmm",
)
"""How those notes begin that most exports of a format have."""


def notes_of(job: ExportJob, *, usual: bool = False) -> list[str]:
    """Return what the table of an export says, the cells of each row between bars; not the usual notes."""
    notes = [note for note in job.notes if usual or not note.what.startswith(USUAL_NOTES)]
    return [" | ".join(filter(None, note)) for note in notes]


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


def read_independently(path: Path) -> IndependentC3d:
    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about components that the file does not have
        reader = c3d.Reader(file)
        frames = list(reader.read_frames())
        labels = [str(label).strip() for label in reader.point_labels]
    points = np.array([frame[1] for frame in frames], np.float32)
    analog = float32(
        np.concatenate([frame[2].T for frame in frames])
    )  # (channels, samples); (0,) without any
    rates_hz = (reader.point_rate, reader.analog_rate)
    return IndependentC3d(*rates_hz, labels, points, points[..., 3] >= 0, analog)
