"""Export to C3D, read by ezc3d and by the package ``c3d``."""

import math
import os
import warnings
from dataclasses import replace
from pathlib import Path

import lcm
import numpy as np
import pytest

from gateway.errors import TakeError
from gateway.export.formats import export_take
from gateway.export.job import ExportJob
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import EventDefinition, EventParameter, ExpectedValue, ParametersEvents
from gateway.simulator.c3d_scene import C3dScene
from gateway.simulator.synthetic import SyntheticScene
from tests.recorded_scenes import record_scene, scene_messages
from tests.takes import description, frame, parameters
from tests.unit.export.c3d_takes import NAN, SCENE, float32, labelled, visible
from tests.unit.export.exported import export_messages, read_ezc3d, read_independently


@pytest.mark.takes
@pytest.mark.parametrize(("name", "num_frames"), [("qualisys", 340), ("optotrak", 29)])
def test_a_recorded_c3d_file_is_exported_as_it_was(tmp_path: Path, name: str, num_frames: int) -> None:
    original_path = Path(os.environ["RTC3D_TAKES"]) / f"{name}.c3d"
    take = record_scene(tmp_path / "take.lcmlog", C3dScene(original_path), num_frames)
    job = ExportJob(take, tmp_path / "out.c3d")
    assert export_take(job) == [tmp_path / "out.c3d"]
    assert job.notes == []
    original, copy = read_ezc3d(original_path), read_ezc3d(tmp_path / "out.c3d")
    for group, names in {
        "POINT": ("LABELS", "DESCRIPTIONS", "RATE", "FRAMES", "USED"),
        "ANALOG": ("LABELS", "DESCRIPTIONS", "UNITS", "RATE", "USED"),
        "FORCE_PLATFORM": ("USED", "TYPE", "CHANNEL", "CORNERS", "CAL_MATRIX"),
    }.items():
        for parameter in names:
            found = copy["parameters"][group][parameter]["value"]
            assert np.array_equal(found, original["parameters"][group][parameter]["value"]), parameter
    assert copy["parameters"]["POINT"]["UNITS"]["value"] == ["mm"]
    assert np.array_equal(
        float32(copy["data"]["points"]), float32(original["data"]["points"]), equal_nan=True
    )
    assert np.array_equal(
        copy["data"]["meta_points"]["residuals"], original["data"]["meta_points"]["residuals"]
    )
    assert np.array_equal(float32(copy["data"]["analogs"]), float32(original["data"]["analogs"]))
    for found, expected in zip(copy["data"]["platform"], original["data"]["platform"], strict=True):
        for field in ("force", "moment", "center_of_pressure", "corners", "origin", "cal_matrix"):
            assert np.array_equal(found[field], expected[field], equal_nan=True), field
        assert (found["unit_force"], found["unit_moment"]) == (
            expected["unit_force"],
            expected["unit_moment"],
        )
    ours, theirs = read_independently(tmp_path / "out.c3d"), read_independently(original_path)
    assert (ours.labels, ours.point_rate_hz, ours.analog_rate_hz) == (
        theirs.labels,
        theirs.point_rate_hz,
        theirs.analog_rate_hz,
    )
    assert np.array_equal(ours.is_visible, theirs.is_visible)
    seen = ours.is_visible
    assert np.array_equal(ours.points[seen][:, :3], theirs.points[seen][:, :3])
    assert np.array_equal(ours.analog, theirs.analog)


def test_missing_markers_and_residuals(tmp_path: Path) -> None:
    rows: list[list[tuple[float, ...]]] = [
        [(1, 2, 3, 0.25), (NAN, NAN, NAN, 999), (0, 0, 0, 0)],
        [(NAN, 2, 3, 0.5), (4, 5, 6, 0.75), (7, 8, 9, 31.75)],
    ]
    messages = [frame(ComponentType.MARKERS, row, number) for number, row in enumerate(rows)]
    export_messages(tmp_path, [labelled("a", "b", "c", unit="m"), *messages], "out.c3d")
    content = read_ezc3d(tmp_path / "out.c3d")
    expected = np.array([[[1, 2, 3], [NAN] * 3, [0, 0, 0]], [[NAN] * 3, [4, 5, 6], [7, 8, 9]]])
    assert np.array_equal(content["data"]["points"][:3].T.transpose(0, 1, 2), expected, equal_nan=True)
    residuals = content["data"]["meta_points"]["residuals"][0].T
    assert residuals.tolist() == [[0.25, -1, 0], [-1, 0.75, 31.75]]
    assert content["parameters"]["POINT"]["UNITS"]["value"] == ["m"]
    independent = read_independently(tmp_path / "out.c3d")
    assert independent.points[..., 3].tolist() == [[0.25, -1, 0], [-1, 0.75, 31.75]]


def test_residuals_have_127_steps(tmp_path: Path) -> None:
    residuals = np.random.default_rng(4).uniform(0, 2, 300)
    messages = [frame(ComponentType.MARKERS, [(1, 2, 3, value)], n) for n, value in enumerate(residuals)]
    export_messages(tmp_path, [labelled("a"), *messages], "out.c3d")
    found = read_ezc3d(tmp_path / "out.c3d")["data"]["meta_points"]["residuals"][0, 0]
    assert abs(found - residuals).max() <= residuals.max() / 127 / 2 + 1e-6


def test_events_have_their_labels_and_times(tmp_path: Path) -> None:
    button = EventDefinition(
        "0x10",
        "Button",
        "Button action",
        (
            EventParameter("1", "int", "Button id"),
            EventParameter(
                "2", "int", "State", (ExpectedValue("1", "1", "ON"), ExpectedValue("2", "0", "OFF"))
            ),
            EventParameter("3", "float", "Force"),
        ),
    )
    described = replace(SCENE.parameters, events=ParametersEvents((button,)))
    half = int.from_bytes(np.float32(0.5).tobytes(), "little")
    start = 5_000_000
    events = [
        frame(
            ComponentType.EVENT,
            [(16, start + 250_000, 7, 1, half)],
            0,
            timestamp_us=start + 255_000,
            utime=1_700_000_000_258_000,
        ),
        frame(
            ComponentType.EVENT,
            [(9, 0, 3, -1, -1)],
            1,
            timestamp_us=start + 400_000,
            utime=1_700_000_000_403_000,
        ),
        frame(
            ComponentType.EVENT,
            [(9, 0, -1, -1, -1)],
            2,
            timestamp_us=start + 900_000_000,
            utime=1_700_000_900_000_000,
        ),
    ]
    export_messages(tmp_path, [parameters(described), *scene_messages(SCENE, 100), *events], "out.c3d")
    group = read_ezc3d(tmp_path / "out.c3d")["parameters"]["EVENT"]
    assert group["USED"]["value"].tolist() == [2]
    assert group["LABELS"]["value"] == ["Button", "event 9"]
    assert group["DESCRIPTIONS"]["value"] == ["Button id: 7; State: ON; Force: 0.5", "param1: 3"]
    assert group["TIMES"]["value"].tolist() == [[0, 0], [0.25, pytest.approx(0.4)]]


def test_labels_that_c3d_cannot_hold_are_changed_and_reported(tmp_path: Path) -> None:
    labels = ["a\nb", "Ä" * 90, "x" * 150 + "1", "x" * 150 + "2"]
    messages = [frame(ComponentType.MARKERS, visible((1, 2, 3)) * 4, n) for n in range(3)]
    job = export_messages(tmp_path, [labelled(*labels), *messages], "out.c3d")
    found = read_ezc3d(tmp_path / "out.c3d")["parameters"]["POINT"]["LABELS"]["value"]
    assert found == ["a_b", "Ä" * 60, "x" * 120, "x" * 118 + "_2"]
    assert job.notes == ["4 labels of markers were changed, because a C3D file cannot hold them"]


@pytest.mark.parametrize("num_markers", [255, 256, 600, 4000])
def test_many_markers(tmp_path: Path, num_markers: int) -> None:
    labels = [f"marker with a name {n}" for n in range(num_markers)]
    row = [(n, 1, 2, 0.0) for n in range(num_markers)]
    job = export_messages(tmp_path, [labelled(*labels), frame(ComponentType.MARKERS, row)], "out.c3d")
    content = read_ezc3d(tmp_path / "out.c3d")
    points = content["parameters"]["POINT"]
    parts = [points.get(f"LABELS{part or ''}", {"value": []})["value"] for part in (0, *range(2, 20))]
    found: list[str] = [label for part in parts for label in part]
    assert content["data"]["points"][0, :, 0].tolist() == list(range(num_markers))
    assert read_independently(tmp_path / "out.c3d").points[0, :, 0].tolist() == list(range(num_markers))
    assert len(set(found)) == num_markers
    if num_markers < 4000:
        assert found == labels
        assert job.notes == []


def test_a_long_recording_has_all_its_frames(tmp_path: Path) -> None:
    count = 70_000
    messages = [frame(ComponentType.MARKERS, [(n, 1, 2, 0)], n) for n in range(count)]
    export_messages(tmp_path, [labelled("a"), *messages], "out.c3d")
    expected = np.arange(count, dtype=np.float32)
    assert np.array_equal(read_ezc3d(tmp_path / "out.c3d")["data"]["points"][0, 0], expected)
    assert np.array_equal(read_independently(tmp_path / "out.c3d").points[:, 0, 0], expected)


def test_residuals_of_a_damaged_frame_cause_no_warning(tmp_path: Path) -> None:
    items = [(1.0, 2.0, 3.0, 1e-40), (1.0, 2.0, 3.0, 0.5), (1.0, 2.0, 3.0, math.inf)]
    frames = [frame(ComponentType.MARKERS, items, n) for n in range(3)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        export_messages(tmp_path, [labelled("a", "b", "c"), *frames], "out.c3d")
    residuals = read_independently(tmp_path / "out.c3d").points[0, :, 3]
    assert residuals[0] == 0
    assert residuals[1] == pytest.approx(0.5, rel=1e-3)


def test_a_take_without_parameters(tmp_path: Path) -> None:
    job = export_messages(tmp_path, [description(), *scene_messages(SCENE, 20)], "out.c3d")
    assert job.notes == [
        "the take has no parameters of lab: labels, units and rates are not known",
        "forces of plates without parameters were left out: 2, because their corners are not known; "
        "export to .csv has them",
    ]
    content = read_ezc3d(tmp_path / "out.c3d")
    assert content["parameters"]["POINT"]["LABELS"]["value"] == [f"marker {n}" for n in range(1, 6)]
    assert content["parameters"]["POINT"]["RATE"]["value"].tolist() == [100]
    assert content["parameters"]["ANALOG"]["RATE"]["value"].tolist() == [1000]
    assert content["data"]["analogs"].shape == (1, 3, 200)


@pytest.mark.parametrize("rate_hz", [59.94, 119.88, 29.97, 1000 / 3])
@pytest.mark.parametrize("ratio", [7, 10, 20])
def test_readers_find_the_exact_ratio_of_odd_rates(tmp_path: Path, rate_hz: float, ratio: int) -> None:
    scene = SyntheticScene(
        markers=1, tools=0, analog=1, plates=0, rate_hz=rate_hz, analog_rate_hz=rate_hz * ratio
    )
    export_messages(tmp_path, [parameters(scene.parameters), *scene_messages(scene, 30)], "out.c3d")
    content = read_ezc3d(tmp_path / "out.c3d")
    assert content["data"]["analogs"].shape == (1, 1, 30 * ratio)
    assert content["parameters"]["POINT"]["RATE"]["value"][0] == pytest.approx(rate_hz, rel=1e-5)
    assert read_independently(tmp_path / "out.c3d").analog.shape == (30 * ratio, 1)


def test_analog_with_a_rate_that_c3d_cannot_have_is_reported(tmp_path: Path) -> None:
    scene = SyntheticScene(markers=2, tools=0, analog=3, plates=0, rate_hz=100, analog_rate_hz=250)
    job = export_messages(tmp_path, [parameters(scene.parameters), *scene_messages(scene, 50)], "out.c3d")
    (note,) = job.notes
    assert note.startswith("analog was left out: in C3D, its rate must be a multiple of that of the frames;")
    assert read_ezc3d(tmp_path / "out.c3d")["data"]["points"].shape == (4, 2, 50)


def test_analog_without_markers(tmp_path: Path) -> None:
    messages = [message for message in scene_messages(SCENE, 20) if "ANALOG" in message[0]]
    export_messages(tmp_path, [parameters(SCENE.parameters), *messages], "out.c3d")
    content = read_ezc3d(tmp_path / "out.c3d")
    assert content["data"]["points"].shape == (4, 0, 200)
    assert content["parameters"]["ANALOG"]["RATE"]["value"].tolist() == [1000]
    assert np.array_equal(
        float32(content["data"]["analogs"][0]), SCENE.items(ComponentType.ANALOG, np.arange(200)).T
    )


def test_a_take_without_anything_for_c3d_is_an_error(tmp_path: Path) -> None:
    event = frame(ComponentType.EVENT, [(1, 2, -1, -1, -1)])
    with pytest.raises(
        TakeError, match=r"has no markers, analog channels or forces, and \.c3d holds nothing"
    ):
        export_messages(tmp_path, [event], "out.c3d")
    assert not list(tmp_path.glob("*.c3d"))


def test_a_take_of_lcm_logger_and_one_in_a_folder(tmp_path: Path) -> None:
    messages = [parameters(SCENE.parameters), *scene_messages(SCENE, 40)]
    folder = tmp_path / "folder"
    folder.mkdir()
    for number, part in enumerate((messages[:500], messages[500:])):
        log = lcm.EventLog(str(folder / f"take-{number}.lcmlog"), "w")
        for place, (channel, data) in enumerate(part):
            log.write_event(1_800_000_000_000_000 + place, channel, data)
        log.close()
    job = ExportJob(folder, tmp_path / "out.c3d")
    export_take(job)
    content = read_ezc3d(tmp_path / "out.c3d")
    assert np.array_equal(
        float32(content["data"]["analogs"][0, :3]), SCENE.items(ComponentType.ANALOG, np.arange(400)).T
    )
