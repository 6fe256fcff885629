"""Export to CSV: exact numbers, one file per component, without the whole take in memory."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    EventParameter,
    ForceChannel,
    Marker,
    Parameters,
    Parameters3D,
    ParametersAnalog,
    ParametersEvents,
    ParametersForce,
    Plate,
)
from gateway.simulator.synthetic import SyntheticScene
from gateway.takes.files import event_log, reader
from tests.support.errors import each_names
from tests.support.takes import START_UTIME, frame, markers, parameters
from tests.unit.takes.export.exported import NAN, export_messages, labelled, notes_of, scene

SCENE = SyntheticScene(markers=3, tools=2, analog=2, plates=1, rate_hz=100, analog_rate_hz=1000)
HEAD = ["time_s", "capture_utime", "utime", "sequence", "session", "frame_number", "timestamp_us"]


def read_csv(path: Path) -> tuple[list[str], list[list[str]]]:
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file, strict=True))
    assert {len(row) for row in rows} == {len(rows[0])}
    return rows[0], rows[1:]


def test_every_value_of_every_component_is_exported_exactly(tmp_path: Path) -> None:
    job = export_messages(tmp_path, scene(30, SCENE), "walk.csv")
    assert sorted(path.name for path in job.files.paths) == [
        "walk-3d.csv",
        "walk-6d.csv",
        "walk-analog.csv",
        "walk-force.csv",
    ]
    assert notes_of(job) == []
    for component in (ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.ANALOG, ComponentType.FORCE):
        head, rows = read_csv(tmp_path / f"walk-{component.key}.csv")
        assert head[:7] == HEAD
        recorded = SCENE.items(component, np.arange(len(rows)))
        expected = np.ascontiguousarray(recorded).view(">f4").astype(np.float32).reshape(len(rows), -1)
        found = np.array([[cell or "nan" for cell in row[7:]] for row in rows], np.float32)
        assert np.array_equal(found, expected, equal_nan=True)
        assert [int(row[3]) for row in rows] == list(range(len(rows)))
        seconds = [(int(row[1]) - START_UTIME) / 1e6 for row in rows]
        assert [float(row[0]) for row in rows] == pytest.approx(seconds, abs=0.01)


def test_titles_have_labels_and_units(tmp_path: Path) -> None:
    units = [ForceChannel(str(n), unit="N" if n < 3 else "Nm") for n in range(6)]
    described = Parameters(
        markers=Parameters3D(100.0, "m", (Marker("1", 'the "left", knee'),)),
        force=ParametersForce((Plate("1", "plate", channels=tuple(units)),)),
    )
    messages = [
        parameters(described),
        markers(1),
        frame(ComponentType.FORCE, [(1, 2, 3, 4, 5, 6)]),
        frame(ComponentType.ANALOG, [0.1]),
        frame(ComponentType.TOOLS, [(1, 0, 0, 0, 1, 2, 3, 0.5)]),
    ]
    export_messages(tmp_path, messages, "walk.csv")
    head, rows = read_csv(tmp_path / "walk-3d.csv")
    knee = 'the "left", knee'
    assert head[7:] == [f"{knee} x (m)", f"{knee} y (m)", f"{knee} z (m)", f"{knee} reliability (m)"]
    assert rows[0][7:] == ["0.0", "0.0", "0.5", "0.1"]
    assert b'"the ""left"", knee x (m)"' in (tmp_path / "walk-3d.csv").read_bytes()
    for key, label, titles in (
        ("force", "plate", "fx (N),fy (N),fz (N),mx (Nm),my (Nm),mz (Nm)"),
        ("analog", "channel 1", "(mV)"),
        ("6d", "tool 1", "q0,qx,qy,qz,x (m),y (m),z (m),error (m)"),
    ):
        expected = [f"{label} {title}" for title in titles.split(",")]
        assert read_csv(tmp_path / f"walk-{key}.csv")[0][7:] == expected


def test_titles_differ_also_if_a_label_ends_like_a_unit(tmp_path: Path) -> None:
    channels = (AnalogChannel("1", "x (V)", unit=""), AnalogChannel("2", "x", unit="V"))
    described = Parameters(analog=ParametersAnalog(channels))
    export_messages(tmp_path, [parameters(described), frame(ComponentType.ANALOG, [1, 2])], "walk.csv")
    assert read_csv(tmp_path / "walk-analog.csv")[0][7:] == ["x (V)", "x (V)_2"]


def test_markers_called_like_a_column_of_time_change_nothing(tmp_path: Path) -> None:
    job = export_messages(tmp_path, [labelled("session"), markers(1)], "walk.csv")
    assert notes_of(job) == []


def test_missing_values_are_empty_and_extreme_ones_exact(tmp_path: Path) -> None:
    rows: list[list[tuple[float, ...]]] = [
        [(NAN, NAN, NAN, 999), (1e-45, -0.0, 3.4e38, 1 / 3)],
        [(math.inf, -math.inf, 16777216, 0.1)] * 2,
    ]
    messages = [frame(ComponentType.MARKERS, row, number) for number, row in enumerate(rows)]
    export_messages(tmp_path, [labelled("banana", "nan"), *messages], "walk.csv")
    head, found = read_csv(tmp_path / "walk-3d.csv")
    assert head[7] == "banana x (mm)"
    assert found[0][7:] == ["", "", "", "999.0", "1e-45", "-0.0", "3.4e+38", "0.33333334"]
    assert found[1][7:11] == ["inf", "-inf", "1.6777216e+07", "0.1"]


def test_frames_without_items_have_their_times(tmp_path: Path) -> None:
    export_messages(tmp_path, [markers(0, 4), markers(0, 5)], "walk.csv")
    head, rows = read_csv(tmp_path / "walk-3d.csv")
    assert head == HEAD
    assert [row[3] for row in rows] == ["4", "5"]


def test_events_have_one_row_each(tmp_path: Path) -> None:
    definition = EventDefinition("0x10", "Button, red", parameters=(EventParameter("1", "string", "Side"),))
    events = [(16, 5_000_000, int.from_bytes(b"LEFT", "big"), -1, -1), (-3, -1, 1, 2, 3)]
    messages = [
        parameters(Parameters(events=ParametersEvents((definition,)))),
        frame(ComponentType.EVENT, events, 3),
        frame(ComponentType.EVENT, [(16, 7, -1, -1, -1)], 4),
    ]
    export_messages(tmp_path, messages, "walk.csv")
    head, rows = read_csv(tmp_path / "walk-event.csv")
    assert head[7:] == ["id", "label", "event_timestamp_us", "param1", "param2", "param3", "description"]
    assert [row[3] for row in rows] == ["3", "3", "4"]
    assert rows[0][7:] == ["16", "Button, red", "5000000", "1279608404", "-1", "-1", "Side: LEFT"]
    assert rows[1][7:] == ["-3", "event -3", "-1", "1", "2", "3", "param1: 1; param2: 2; param3: 3"]
    assert rows[2][7:] == ["16", "Button, red", "7", "-1", "-1", "-1", ""]


def test_labels_that_change_begin_another_file_and_return_to_the_first(tmp_path: Path) -> None:
    messages = [labelled("a", "b"), markers(2, 0), labelled("c", "b", version=2), markers(2, 1, version=2)]
    messages += [markers(2, 2, version=1), markers(3, 3, version=2)]
    job = export_messages(tmp_path, messages, "walk.csv")
    assert [path.name for path in job.files.paths] == ["walk-3d.csv", "walk-3d-2.csv", "walk-3d-3.csv"]
    assert each_names(notes_of(job), ["labels", "3d", "lab", 3])
    sequences = [[row[3] for row in read_csv(path)[1]] for path in job.files.paths]
    assert sequences == [["0", "2"], ["1"], ["3"]]
    assert read_csv(tmp_path / "walk-3d-3.csv")[0][7::4] == ["c x (mm)", "b x (mm)", "marker 3 x (mm)"]


def test_damage_and_malformed_messages_are_reported(tmp_path: Path) -> None:
    channel, message = markers(2, 5)
    messages = [labelled("a", "b"), *(markers(2, n) for n in range(5))]
    messages += [(channel, message[:-4]), ("SPY", b"other program")]
    job = export_messages(tmp_path, messages, "walk.csv")
    assert len(read_csv(tmp_path / "walk-3d.csv")[1]) == 5
    assert each_names(notes_of(job), ["left out", "SPY", 1], ["malformed", "3d", "lab", 1])


def test_parts_of_a_long_take_follow_each_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    messages = scene(30, SCENE)
    export_messages(tmp_path, messages, "whole.csv")
    monkeypatch.setattr(reader, "_BATCH_BYTES", 1000)
    monkeypatch.setattr(event_log, "_READ_BYTES", 1000)
    export_messages(tmp_path, messages, "parts.csv")
    for key in ("3d", "6d", "analog", "force"):
        assert (tmp_path / f"parts-{key}.csv").read_bytes() == (tmp_path / f"whole-{key}.csv").read_bytes()
