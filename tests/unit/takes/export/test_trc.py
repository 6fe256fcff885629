"""Export to TRC, read by a parser that follows OpenSim's ``TRCFileAdapter``."""

import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Marker, Parameters3D
from gateway.simulator.synthetic import SyntheticScene
from tests.support.errors import each_names
from tests.support.takes import frame, markers, parameters, scene_messages
from tests.unit.takes.export.exported import NAN, export_messages, labelled, notes_of

MARKERS = tuple(Marker(str(number), f"m{number}") for number in range(4))
SCENE = SyntheticScene(markers=4, tools=1, analog=2, plates=1, rate_hz=59.94, analog_rate_hz=599.4)
KEYS = ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units"]
KEYS += ["OrigDataRate", "OrigDataStartFrame", "OrigNumFrames"]


class Trc(NamedTuple):
    """The content of a TRC file; ``positions`` has the shape (frames, markers, 3)."""

    header: dict[str, str]
    labels: list[str]
    numbers: list[int]
    times_s: list[float]
    positions: npt.NDArray[np.float32]


def cells(line: str) -> list[str]:
    """Return the cells of a line: as in OpenSim, an empty one at the end counts only if a tab ends it."""
    found = [cell.strip() for cell in line.split("\t")]
    return found[:-1] if not found[-1] else found


def filled(line: str) -> list[str]:
    return [cell for cell in cells(line) if cell]


def read_trc(path: Path) -> Trc:
    lines = path.read_bytes().decode().split("\n")
    assert re.split(r"[ \t]+", lines[0])[:3] == ["PathFileType", "4", "(X/Y/Z)"]
    keys, values = filled(lines[1]), filled(lines[2])
    assert keys == KEYS
    assert len(values) == len(keys)
    header = dict(zip(keys, values, strict=True))
    count = int(header["NumMarkers"])
    titles = filled(lines[3])
    assert titles[:2] == ["Frame#", "Time"]
    assert len(titles) == count + 2
    assert filled(lines[4]) == [f"{axis}{number}" for number in range(1, count + 1) for axis in "XYZ"]
    assert lines[5] == ""
    numbers, times, rows = [], [], []
    for line in lines[6:-1]:
        row = cells(line)
        assert len(row) == 3 * count + 2
        numbers.append(int(row[0]))
        times.append(float(row[1]))
        markers = [row[start : start + 3] for start in range(2, len(row), 3)]
        rows.append([[float(c) for c in cells] if all(cells) else [NAN] * 3 for cells in markers])
    assert lines[-1] == ""
    assert len(rows) == int(header["NumFrames"])
    return Trc(header, titles[2:], numbers, times, np.array(rows, np.float32).reshape(-1, count, 3))


def test_markers_are_exported_exactly_and_lost_frames_are_empty(tmp_path: Path) -> None:
    lost = {4, 5, 20}

    def keep(component: ComponentType, sample: int) -> bool:
        return component is not ComponentType.MARKERS or sample not in lost

    described = replace(SCENE.parameters, markers=Parameters3D(59.94, "mm", MARKERS))
    messages = [parameters(described), *scene_messages(SCENE, 60, keep=keep)]
    job = export_messages(tmp_path, messages, "walk.trc")
    assert each_names(notes_of(job), ["walk.trc", "frames", "3 of 60"])
    found = read_trc(tmp_path / "walk.trc")
    assert [*found.header.values()] == ["59.94", "59.94", "60", "4", "mm", "59.94", "1", "60"]
    assert found.numbers == list(range(1, 61))
    assert np.diff(found.times_s) == pytest.approx(1 / 59.94, abs=2e-6)
    recorded = SCENE.items(ComponentType.MARKERS, np.arange(60))
    expected = np.stack([recorded[axis] for axis in "xyz"], axis=2).astype(np.float32)
    expected[sorted(lost)] = NAN
    assert np.array_equal(found.positions, expected, equal_nan=True)


def test_missing_markers_have_empty_cells_also_at_the_end(tmp_path: Path) -> None:
    rows: list[list[tuple[float, ...]]] = [
        [(NAN, NAN, NAN, 999), (1e-5, -2.5, 1e20, 0), (NAN, NAN, NAN, 999)],
        [(1, NAN, 3, 0), (NAN, NAN, NAN, 999), (0, 0, 0, 0)],
    ]
    messages = [frame(ComponentType.MARKERS, row, number) for number, row in enumerate(rows)]
    export_messages(tmp_path, [labelled("a", "b", "c", unit="m"), *messages], "walk.trc")
    found = read_trc(tmp_path / "walk.trc")
    assert found.header["Units"] == "m"
    assert np.isnan(found.positions).all(axis=2).tolist() == [[True, False, True], [True, True, False]]
    assert found.positions[0, 1].tolist() == np.array([1e-5, -2.5, 1e20], np.float32).tolist()


def test_labels_are_valid_and_different(tmp_path: Path) -> None:
    labels = ["left knee", "left\tknee", "", "a/b", "Ä.1", "x" * 200]
    row = [(n, 0, 0, 0) for n in range(len(labels))]
    job = export_messages(tmp_path, [labelled(*labels), frame(ComponentType.MARKERS, row)], "walk.trc")
    found = read_trc(tmp_path / "walk.trc")
    assert found.labels == ["left_knee", "left_knee_2", "marker_3", "a_b", "Ä.1", "x" * 100]
    assert found.positions[0, :, 0].tolist() == [0, 1, 2, 3, 4, 5]
    assert each_names(notes_of(job), ["walk.trc", "labels of markers", 5])


def test_a_unit_that_opensim_does_not_know_is_reported(tmp_path: Path) -> None:
    messages = [labelled("a", unit="inch"), frame(ComponentType.MARKERS, [(1, 2, 3, 0)])]
    job = export_messages(tmp_path, messages, "walk.trc")
    assert each_names(notes_of(job), ["walk.trc", "inch", "mm", "m"])


def test_a_unit_cannot_break_the_head(tmp_path: Path) -> None:
    messages = [labelled("a", unit="m\tm"), frame(ComponentType.MARKERS, [(1, 2, 3, 0)])]
    export_messages(tmp_path, messages, "walk.trc")
    assert (tmp_path / "walk.trc").read_text().splitlines()[2].split("\t")[3:6] == ["1", "m_m", "100"]


@pytest.mark.parametrize("character", [*"*+/\\ "])
def test_labels_have_no_character_that_opensim_forbids(tmp_path: Path, character: str) -> None:
    export_messages(tmp_path, [labelled(f"a{character}b"), markers(1)], "out.trc")
    assert read_trc(tmp_path / "out.trc").labels == ["a_b"]
