"""Export to C3D, read by ezc3d and by the package ``c3d``."""

import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gateway.messages.descriptions.labels import EventText
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    EventParameter,
    ExpectedValue,
    ForceChannel,
    Parameters,
    ParametersAnalog,
    ParametersEvents,
    ParametersForce,
    Plate,
    Point,
)
from gateway.simulator.c3d_scene import C3dScene
from gateway.simulator.synthetic import SyntheticScene
from gateway.takes.export.c3d import _context_of
from gateway.takes.export.job import ExportJob, export_take
from tests.support.errors import each_names, names, one_names
from tests.support.takes import (
    SERVER_START_US,
    START_UTIME,
    Message,
    description,
    details,
    frame,
    parameters,
    record_scene,
    scene_messages,
)
from tests.unit.takes.export.exported import (
    NAN,
    SCENE,
    C3d,
    export_c3d,
    export_messages,
    labelled,
    notes_of,
    read_independently,
    samples,
    scene,
)


def points(*rows: Sequence[tuple[float, ...]]) -> list[Message]:
    """Return frames of markers with these coordinates and residuals."""
    return [frame(ComponentType.MARKERS, row, number) for number, row in enumerate(rows)]


@pytest.mark.takes
@pytest.mark.parametrize(("name", "num_frames"), [("qualisys", 340), ("optotrak", 29)])
def test_a_recorded_c3d_file_is_exported_as_it_was(tmp_path: Path, name: str, num_frames: int) -> None:
    original_path, copy_path = Path(os.environ["RTC3D_TAKES"]) / f"{name}.c3d", tmp_path / "out.c3d"
    take = record_scene(tmp_path / "take.lcmlog", C3dScene(original_path), num_frames)
    job = ExportJob(take, copy_path)
    assert export_take(job) == [copy_path]
    assert len(notes_of(job, usual=True)) == 1  # about the grid: residuals are exact, plates as they were
    original, copy = C3d(original_path), C3d(copy_path)
    for group, keys in {
        "POINT": ("LABELS", "DESCRIPTIONS", "RATE", "FRAMES", "USED"),
        "ANALOG": ("LABELS", "DESCRIPTIONS", "UNITS", "RATE", "USED"),
        "FORCE_PLATFORM": ("USED", "TYPE", "CHANNEL", "CORNERS", "CAL_MATRIX"),
    }.items():
        for each in keys:
            assert np.array_equal(copy(group, each), original(group, each)), each
    assert copy("POINT", "UNITS") == ["mm"]
    for each in ("points", "residuals", "analog"):
        assert np.array_equal(getattr(copy, each), getattr(original, each), equal_nan=True), each
    for found, expected in zip(copy.plates, original.plates, strict=True):
        for field in ("force", "moment", "center_of_pressure", "corners", "origin", "cal_matrix"):
            assert np.array_equal(found[field], expected[field], equal_nan=True), field
        for field in ("unit_force", "unit_moment"):
            assert found[field] == expected[field]
    ours, theirs = read_independently(copy_path), read_independently(original_path)
    assert ours[:3] == (theirs.point_rate_hz, theirs.analog_rate_hz, theirs.labels)
    assert np.array_equal(ours.is_visible, theirs.is_visible)
    seen = ours.is_visible
    assert np.array_equal(ours.points[seen][:, :3], theirs.points[seen][:, :3])
    assert np.array_equal(ours.analog, theirs.analog)


def test_missing_markers_and_residuals(tmp_path: Path) -> None:
    messages = points(
        [(1, 2, 3, 0.25), (NAN, NAN, NAN, 999), (0, 0, 0, 0)],
        [(NAN, 2, 3, 0.5), (4, 5, 6, 0.75), (7, 8, 9, 31.75)],
    )
    found, _ = export_c3d(tmp_path, [labelled("a", "b", "c", unit="m"), *messages])
    expected = np.array([[[1, 2, 3], [NAN] * 3, [0, 0, 0]], [[NAN] * 3, [4, 5, 6], [7, 8, 9]]])
    assert np.array_equal(found.points[:3].T, expected, equal_nan=True)
    residuals = [[0.25, -1, 0], [-1, 0.75, 31.75]]
    assert found.residuals.T.tolist() == residuals
    assert found("POINT", "UNITS") == ["m"]
    assert read_independently(tmp_path / "out.c3d").points[..., 3].tolist() == residuals


def test_residuals_have_127_steps_and_those_of_a_damaged_frame_cause_no_warning(tmp_path: Path) -> None:
    residuals = np.random.default_rng(4).uniform(0, 2, 300)
    messages = points(*([(1, 2, 3, value)] for value in residuals))
    job = export_messages(tmp_path, [labelled("a"), *messages], "out.c3d")
    found = C3d(tmp_path / "out.c3d")
    assert one_names(notes_of(job, usual=True), "out.c3d", "residuals", "127 steps", "0.0157 mm")
    assert abs(found.residuals[0] - residuals).max() <= residuals.max() / 127 / 2 + 1e-6
    (folder := tmp_path / "damaged").mkdir()
    items = [(1.0, 2.0, 3.0, residual) for residual in (1e-40, 0.5, math.inf)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        export_c3d(folder, [labelled("a", "b", "c"), *points(items, items, items)])
    damaged = read_independently(folder / "out.c3d").points[0, :, 3]
    assert damaged[:2].tolist() == [0, pytest.approx(0.5, rel=1e-3)]


def test_events_have_their_labels_and_times(tmp_path: Path) -> None:
    state = EventParameter(
        "2", "int", "State", (ExpectedValue("1", "1", "ON"), ExpectedValue("2", "0", "OFF"))
    )
    values = (EventParameter("1", "int", "Button id"), state, EventParameter("3", "float", "Force"))
    button = EventDefinition("0x10", "Button", "Button action", values)
    described = replace(SCENE.parameters, events=ParametersEvents((button,)))
    half, start = int.from_bytes(np.float32(0.5).tobytes(), "little"), 5_000_000
    events = [
        frame(ComponentType.EVENT, [event], n, timestamp_us=start + at_us, utime=START_UTIME + at_us + 3000)
        for n, (event, at_us) in enumerate(
            [
                ((16, start + 250_000, 7, 1, half), 255_000),
                ((9, 0, 3, -1, -1), 400_000),
                ((9, 0, 4, -1, -1), -200_000),
                ((9, 0, -1, -1, -1), 900_000_000),
            ]
        )
    ]
    about = details("ü" * 64)
    found, notes = export_c3d(tmp_path, [parameters(described), about, *scene_messages(SCENE, 100), *events])
    assert found("EVENT", "USED").tolist() == [3]
    assert found("EVENT", "LABELS") == ["event 9", "Button", "event 9"]
    assert found("EVENT", "DESCRIPTIONS") == ["param1: 4", "Button id: 7; State: ON; Force: 0.5", "param1: 3"]
    assert found("EVENT", "TIMES").tolist() == [[0, 0, 0], [0, 0.25, pytest.approx(0.4)]]
    assert one_names(notes, "events", "first frame", 1)
    assert one_names(notes, "events of lab", "left out", 1)
    assert found("EVENT", "SUBJECTS") == ["ü" * 60] * 3
    assert one_names(notes, "cut", "4 to 120 bytes")


def test_events_have_their_side_as_context(tmp_path: Path) -> None:
    """Programs for gait analysis find the steps by label and context."""

    def choice(number: str, name: str, *labels: str) -> EventParameter:
        values = (ExpectedValue(str(n), str(n), label) for n, label in enumerate(labels))
        return EventParameter(number, "int", name, tuple(values))

    foot = choice("1", "Foot", "LEFT", "RIGHT")
    definitions = (
        EventDefinition("1", "Foot strike", parameters=(foot,)),
        EventDefinition("2", "Right foot off"),
        EventDefinition("3", "Left turn", parameters=(choice("1", "Context", "Invalid"),)),
        EventDefinition("4", "Button", parameters=(choice("1", "Subject", "Anna"),)),
    )
    described = replace(SCENE.parameters, events=ParametersEvents(definitions))
    items = [(1, 0, 0, -1, -1), (1, 0, 1, -1, -1), (2, 0, -1, -1, -1), (3, 0, 0, -1, -1), (4, 0, 0, -1, -1)]
    events = [
        frame(ComponentType.EVENT, [item], n, timestamp_us=5_000_000, utime=START_UTIME + 3000)
        for n, item in enumerate(items)
    ]
    about = details("S01", "baseline", "left knee, second visit after surgery")
    found, _ = export_c3d(tmp_path, [about, parameters(described), *scene_messages(SCENE, 100), *events])
    assert (found("SUBJECTS", "USED").tolist(), found("SUBJECTS", "NAMES")) == ([1], ["S01"])
    assert found("TRIAL", "SESSION") == ["baseline"]
    assert found("TRIAL", "NOTE") == ["left knee, second visit after", "surgery"]
    assert found("EVENT", "CONTEXTS") == ["Left", "Right", "Right", "Invalid", "General"]
    assert found("EVENT", "SUBJECTS") == ["S01", "S01", "S01", "S01", "Anna"]


def test_labels_that_c3d_cannot_hold_are_changed_and_reported(tmp_path: Path) -> None:
    labels = ["a\nb", "Ä" * 90, "x" * 150 + "1", "x" * 150 + "2"]
    messages = points(*[[(1, 2, 3, 0)] * 4] * 3)
    found, notes = export_c3d(tmp_path, [labelled(*labels), *messages])
    assert found("POINT", "LABELS") == ["a_b", "Ä" * 60, "x" * 120, "x" * 118 + "_2"]
    assert each_names(notes, ["labels of markers", 4])


@pytest.mark.parametrize("num_markers", [255, 256, 600, 4000])
def test_many_markers(tmp_path: Path, num_markers: int) -> None:
    labels = [f"marker with a name {n}" for n in range(num_markers)]
    row = [(n, 1, 2, 0.0) for n in range(num_markers)]
    found, notes = export_c3d(tmp_path, [labelled(*labels), *points(row)])
    parts = ("", *range(2, 20))
    exported = [label for part in parts for label in found("POINT", f"LABELS{part}")]
    assert found.points[0, :, 0].tolist() == list(range(num_markers))
    assert read_independently(tmp_path / "out.c3d").points[0, :, 0].tolist() == list(range(num_markers))
    assert len(set(exported)) == num_markers
    if num_markers < 4000:
        assert (exported, notes) == (labels, [])


def test_a_long_recording_has_all_its_frames(tmp_path: Path) -> None:
    found, _ = export_c3d(tmp_path, [labelled("a"), *points(*([(n, 1, 2, 0)] for n in range(70_000)))])
    expected = np.arange(70_000, dtype=np.float32)
    assert np.array_equal(found.points[0, 0], expected)
    assert np.array_equal(read_independently(tmp_path / "out.c3d").points[:, 0, 0], expected)


def test_a_take_without_parameters(tmp_path: Path) -> None:
    found, notes = export_c3d(tmp_path, [description(), *scene_messages(SCENE, 20)])
    assert each_names(notes, ["no parameters", "lab"], ["plates", ".csv", 2])
    assert found("POINT", "LABELS") == [f"marker {n}" for n in range(1, 6)]
    assert (*found("POINT", "RATE"), *found("ANALOG", "RATE")) == (100, 1000)
    assert found.analog.shape == (3, 200)


@pytest.mark.parametrize("rate_hz", [59.94, 119.88, 29.97, 1000 / 3])
@pytest.mark.parametrize("ratio", [7, 10, 20])
def test_readers_find_the_exact_ratio_of_odd_rates(tmp_path: Path, rate_hz: float, ratio: int) -> None:
    rates_hz: dict[str, Any] = {"rate_hz": rate_hz, "analog_rate_hz": rate_hz * ratio}
    found, _ = export_c3d(
        tmp_path, scene(30, SyntheticScene(markers=1, tools=0, analog=1, plates=0, **rates_hz))
    )
    assert found.analog.shape == (1, 30 * ratio)
    assert found("POINT", "RATE")[0] == pytest.approx(rate_hz, rel=1e-5)
    assert read_independently(tmp_path / "out.c3d").analog.shape == (30 * ratio, 1)


@pytest.mark.parametrize(("rate_hz", "analog_rate_hz"), [(100, 250), (60, 1000), (30, 2000), (100, 1080)])
def test_analog_with_a_rate_that_c3d_cannot_have_is_reported(
    tmp_path: Path, rate_hz: float, analog_rate_hz: float
) -> None:
    """With 17 samples of 1000 Hz in each of 60 frames a second, channels would drift by 20 ms per second."""
    odd = SyntheticScene(
        markers=2, tools=0, analog=3, plates=0, rate_hz=rate_hz, analog_rate_hz=analog_rate_hz
    )
    found, notes = export_c3d(tmp_path, scene(60, odd))
    count = int(60 * analog_rate_hz / rate_hz)
    assert each_names(
        notes, ["analog left out", "rate", ".sto"], ["rows", "analog", "lab", f"{count} of {count}"]
    )
    assert found.points.shape == (4, 2, 60)


def test_forces_with_another_rate_than_the_channels_are_reported(tmp_path: Path) -> None:
    messages = scene(50, keep=lambda key, _: key is not ComponentType.FORCE)
    for number in range(50):
        time_us = SERVER_START_US + 10_000 * number
        messages.append(frame(ComponentType.FORCE, [(0,) * 6] * 2, number, timestamp_us=time_us))
    _, notes = export_c3d(tmp_path, messages)
    assert each_names(
        notes,
        ["force left out", "rate", ".mot"],
        *(["left out", f"force plate {number}", f"(Force plate {number})"] for number in (1, 2)),
        ["rows", "force", "lab", "50 of 50"],
    )


def test_analog_without_markers(tmp_path: Path) -> None:
    found, _ = export_c3d(
        tmp_path, [each for each in scene(20) if each[0].endswith(("ANALOG", "PARAMETERS"))]
    )
    assert found.points.shape == (4, 0, 200)
    assert found("ANALOG", "RATE").tolist() == [1000]
    assert np.array_equal(found.analog, samples(0, 200))


# Force plates --------------------------------------------------------------------------------

CORNERS = (Point(508, 464, 0), Point(508, 0, 10), Point(0, 0, 10), Point(0, 464, 0))
CALIBRATION = np.diag([100.0, 100, 200, 5000, 5000, 4000]) + 0.3


def test_plates_without_channels_of_their_own_get_six_each(tmp_path: Path) -> None:
    job = export_messages(tmp_path, scene(150), "out.c3d")
    found, notes = C3d(tmp_path / "out.c3d"), notes_of(job)
    assert each_names(notes, ["out.c3d", "forces", "analog", 2])
    assert one_names(notes_of(job, usual=True), "out.c3d", "moments", "Nmm")
    names = [f"{name}{plate}" for plate in (1, 2) for name in ("Fx", "Fy", "Fz", "Mx", "My", "Mz")]
    assert found("ANALOG", "LABELS")[3:] == names
    assert found("ANALOG", "UNITS")[3:9] == ["N"] * 3 + ["Nmm"] * 3
    recorded = SCENE.items(ComponentType.FORCE, np.arange(1500))
    assert SCENE.parameters.force is not None
    for index, (plate, described) in enumerate(zip(found.plates, SCENE.parameters.force.plates, strict=True)):
        force = np.stack([recorded[name][:, index] for name in ("fx", "fy", "fz")])
        moment_nmm = 1000.0 * np.stack([recorded[name][:, index] for name in ("mx", "my", "mz")])
        assert np.allclose(plate["force"], force, rtol=1e-5, atol=1e-3)
        assert np.allclose(plate["moment"], moment_nmm, rtol=1e-5, atol=1.0)
        loaded = force[2] > 100
        corners = np.array([[corner.x, corner.y] for corner in described.corners])
        centre = corners.mean(axis=0)[:, None] + np.stack([-moment_nmm[1], moment_nmm[0]]) / force[2]
        assert np.allclose(plate["center_of_pressure"][:2, loaded], centre[:, loaded], atol=0.1)


def test_forces_beyond_all_numbers_cause_no_warning(tmp_path: Path) -> None:
    loads = ((0, 0, math.inf, 0, 0, 0), (0, 0, 1, 1e38, 0, 0))  # Nm, which become Nmm
    frames = [frame(ComponentType.FORCE, [load] * 2, number) for number, load in enumerate(loads)]
    export_c3d(tmp_path, [parameters(SCENE.parameters), *frames])
    found = read_independently(tmp_path / "out.c3d").analog
    assert not np.isfinite(found[0]).all()
    assert math.isinf(found[1, 3])


def plate_messages(plate: Plate, channels: Any, loads: Any) -> list[Message]:
    """Return a take of a plate's analog channels and of its loads, each (samples, values), at 100 Hz."""
    numbers = range(channels.shape[1])
    analog = (AnalogChannel(str(n + 1), f"c{n}", frequency_hz=100.0) for n in numbers)
    force = ParametersForce((replace(plate, frequency_hz=100.0),))
    messages = [parameters(Parameters(analog=ParametersAnalog(tuple(analog)), force=force))]
    for number, (row, load) in enumerate(zip(channels, loads, strict=True)):
        messages.append(frame(ComponentType.ANALOG, row.tolist(), number))
        messages.append(frame(ComponentType.FORCE, [tuple(load.tolist())], number))
    return messages


@pytest.mark.parametrize("origin", [Point(1.5, -0.8, -34), Point(-1.5, 0.8, 34), None])
@pytest.mark.parametrize(("plate_type", "num_channels"), [(2, 6), (3, 8), (4, 6)])
def test_own_channels_are_used_if_they_give_the_recorded_loads(
    tmp_path: Path, plate_type: int, num_channels: int, origin: Point | None
) -> None:
    channels = np.random.default_rng(2).normal(size=(40, num_channels)) * 30
    plate = Plate(
        "1",
        corners=CORNERS,
        origin=origin,
        channels=tuple(ForceChannel(str(n), unit="N" if n < 3 else "Nmm") for n in range(6)),
        analog_channel_ids=tuple(str(n + 1) for n in range(num_channels)),
        calibration_matrix=tuple(map(tuple, CALIBRATION.tolist())) if plate_type == 4 else (),
    )

    def exported(name: str, loads: Any, *, has_loads: bool = True) -> tuple[C3d, list[str]]:
        (tmp_path / name).mkdir()
        messages = plate_messages(plate, channels, loads)
        return export_c3d(tmp_path / name, [each for each in messages if has_loads or "FORCE" not in each[0]])

    # First let ezc3d compute the loads: without a Force component, the type is taken on trust.
    [computed] = exported("trusted", np.zeros((40, 6)), has_loads=False)[0].plates
    loads = np.concatenate([computed["force"], computed["moment"]]).T
    found, notes = exported("out", loads)
    assert found("FORCE_PLATFORM", "TYPE").tolist() == [plate_type]
    assert found("FORCE_PLATFORM", "CHANNEL")[:, 0].tolist() == list(range(1, num_channels + 1))
    assert found.analog.shape == (num_channels, 40)
    assert np.allclose(found.plates[0]["force"], computed["force"])
    if plate_type == 4:
        assert np.allclose(found("FORCE_PLATFORM", "CAL_MATRIX")[..., 0], CALIBRATION)
    assert notes == []
    # A frame that was lost says nothing about the others.
    (tmp_path / "lost").mkdir()
    messages = plate_messages(plate, channels, loads)
    del messages[[channel for channel, _ in messages].index("MOCAP_LAB_FORCE") + 20]
    found, _ = export_c3d(tmp_path / "lost", messages)
    assert found("FORCE_PLATFORM", "TYPE").tolist() == [plate_type]
    assert found.analog.shape == (num_channels, 40)
    # Loads that do not follow from the channels get channels of their own, which give them.
    found, _ = exported("other", 2 * loads)
    assert found("FORCE_PLATFORM", "TYPE").tolist() == [2]
    assert found.analog.shape == (num_channels + 6, 40)
    [other] = found.plates
    assert np.allclose(other["force"], 2 * computed["force"], rtol=1e-4, atol=1e-2)
    assert np.allclose(other["moment"], 2 * computed["moment"], rtol=1e-4, atol=1.0)


def test_a_plate_without_corners_is_reported(tmp_path: Path) -> None:
    found, [note] = export_c3d(tmp_path, plate_messages(Plate("1", "left"), np.ones((5, 2)), np.ones((5, 6))))
    assert names(note, "force plate 1", "(left)", "left out", "rectangle")
    assert found.analog.shape == (2, 5)


@pytest.mark.parametrize(
    ("label", "values", "context"),
    [
        ("Foot Strike", (("Side", "left"),), "Left"),
        ("Right Foot Off", (), "Right"),
        ("Left and Right", (), "General"),
        ("Left Foot Off", (("Side", "RIGHT"),), "Right"),
        ("Foot Off", (("From", "Left"), ("To", "Right")), "General"),
        ("Left Foot Off", (("From", "Left"), ("To", "Right")), "Left"),
        ("Leftover", (), "General"),
        ("Left", (("Context", "Right"),), "Right"),
        ("Left", ((" CONTEXT ", "Invalid"),), "Invalid"),
        ("Left", (("Context", ""),), "Left"),
    ],
)
def test_the_side_of_an_event_is_clear_or_general(
    label: str, values: tuple[tuple[str, str], ...], context: str
) -> None:
    """A text with both sides has none, and a parameter decides before the label."""
    assert _context_of(EventText(label, values)) == context
