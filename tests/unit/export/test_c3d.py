"""Export to C3D, read by ezc3d and by the package ``c3d``."""

import math
import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import lcm
import numpy as np
import pytest

from gateway.errors import TakeError
from gateway.export.formats import export_take
from gateway.export.job import ExportJob
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    EventParameter,
    ExpectedValue,
    ForceChannel,
    Marker,
    Parameters,
    Parameters3D,
    ParametersAnalog,
    ParametersEvents,
    ParametersForce,
    Plate,
    Point,
)
from gateway.simulator.c3d_scene import C3dScene
from gateway.simulator.synthetic import SyntheticScene
from tests.recorded_scenes import record_scene, scene_messages
from tests.takes import Message, description, frame, parameters
from tests.unit.export.exported import export_messages, read_ezc3d, read_independently

NAN = math.nan
SCENE = SyntheticScene(markers=5, tools=0, analog=3, plates=2, rate_hz=100, analog_rate_hz=1000, seed=5)

PLATES = SCENE.parameters.force.plates if SCENE.parameters.force else ()


def float32(values: Any) -> Any:
    return np.asarray(values).astype(np.float32)


def labelled(*labels: str, unit: str = "mm") -> Message:
    markers = tuple(Marker(str(n), label) for n, label in enumerate(labels))
    return parameters(Parameters(markers=Parameters3D(100.0, unit, markers)))


def visible(*positions: tuple[float, float, float], residual: float = 0.0) -> list[tuple[float, ...]]:
    return [(*position, residual) for position in positions]


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


def test_plates_without_channels_of_their_own_get_six_each(tmp_path: Path) -> None:
    job = export_messages(tmp_path, [parameters(SCENE.parameters), *scene_messages(SCENE, 150)], "out.c3d")
    assert job.notes == []
    content = read_ezc3d(tmp_path / "out.c3d")
    assert content["parameters"]["ANALOG"]["LABELS"]["value"][3:] == [
        *("Fx1", "Fy1", "Fz1", "Mx1", "My1", "Mz1"),
        *("Fx2", "Fy2", "Fz2", "Mx2", "My2", "Mz2"),
    ]
    assert content["parameters"]["ANALOG"]["UNITS"]["value"][3:9] == ["N"] * 3 + ["Nmm"] * 3
    recorded = SCENE.items(ComponentType.FORCE, np.arange(1500))
    assert len(content["data"]["platform"]) == 2
    for index, plate in enumerate(content["data"]["platform"]):
        force = np.stack([recorded[name][:, index] for name in ("fx", "fy", "fz")])
        moment_nmm = 1000.0 * np.stack([recorded[name][:, index] for name in ("mx", "my", "mz")])
        assert np.allclose(plate["force"], force, rtol=1e-5, atol=1e-3)
        assert np.allclose(plate["moment"], moment_nmm, rtol=1e-5, atol=1.0)
        loaded = force[2] > 100
        corners = np.array([[corner.x, corner.y] for corner in PLATES[index].corners])
        centre = corners.mean(axis=0)[:, None] + np.stack([-moment_nmm[1], moment_nmm[0]]) / force[2]
        assert np.allclose(plate["center_of_pressure"][:2, loaded], centre[:, loaded], atol=0.1)


def plate_messages(plate: Plate, channels: Any, loads: Any) -> list[Message]:
    """Return a take of a plate's analog channels and of its loads, each (samples, values), at 100 Hz."""
    count = channels.shape[1]
    described = Parameters(
        analog=ParametersAnalog(
            tuple(AnalogChannel(str(n + 1), f"c{n}", frequency_hz=100.0) for n in range(count))
        ),
        force=ParametersForce((replace(plate, frequency_hz=100.0),)),
    )
    messages = [parameters(described)]
    for number, (row, load) in enumerate(zip(channels, loads, strict=True)):
        messages.append(frame(ComponentType.ANALOG, row.tolist(), number))
        messages.append(frame(ComponentType.FORCE, [tuple(load.tolist())], number))
    return messages


CORNERS = (Point(508, 464, 0), Point(508, 0, 10), Point(0, 0, 10), Point(0, 464, 0))
CALIBRATION = np.diag([100.0, 100, 200, 5000, 5000, 4000]) + 0.3


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
    # First let ezc3d compute the loads: without a Force component, the type is taken on trust.
    only_analog = [
        message for message in plate_messages(plate, channels, np.zeros((40, 6))) if "FORCE" not in message[0]
    ]
    export_messages(tmp_path, only_analog, "trusted.c3d")
    (computed,) = read_ezc3d(tmp_path / "trusted.c3d")["data"]["platform"]
    loads = np.concatenate([computed["force"], computed["moment"]]).T
    job = export_messages(tmp_path, plate_messages(plate, channels, loads), "out.c3d")
    content = read_ezc3d(tmp_path / "out.c3d")
    group = content["parameters"]["FORCE_PLATFORM"]
    assert group["TYPE"]["value"].tolist() == [plate_type]
    assert group["CHANNEL"]["value"][:, 0].tolist() == list(range(1, num_channels + 1))
    assert content["data"]["analogs"].shape == (1, num_channels, 40)
    assert np.allclose(content["data"]["platform"][0]["force"], computed["force"])
    if plate_type == 4:
        assert np.allclose(group["CAL_MATRIX"]["value"][..., 0], CALIBRATION)
    assert job.notes == []
    # Loads that do not follow from the channels get channels of their own, which give them.
    export_messages(tmp_path, plate_messages(plate, channels, 2 * loads), "other.c3d")
    content = read_ezc3d(tmp_path / "other.c3d")
    assert content["parameters"]["FORCE_PLATFORM"]["TYPE"]["value"].tolist() == [2]
    assert content["data"]["analogs"].shape == (1, num_channels + 6, 40)
    (other,) = content["data"]["platform"]
    assert np.allclose(other["force"], 2 * computed["force"], rtol=1e-4, atol=1e-2)
    assert np.allclose(other["moment"], 2 * computed["moment"], rtol=1e-4, atol=1.0)


def test_a_plate_without_corners_is_reported(tmp_path: Path) -> None:
    plate = Plate("1", "left")
    messages = plate_messages(plate, np.ones((5, 2)), np.ones((5, 6)))
    job = export_messages(tmp_path, messages, "out.c3d")
    assert job.notes == [
        "force plate 1 (left) was left out: its parameters do not give the corners of a rectangle"
    ]
    assert read_ezc3d(tmp_path / "out.c3d")["data"]["analogs"].shape == (1, 2, 5)


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


def test_lost_frames_are_empty_and_the_others_keep_their_places(tmp_path: Path) -> None:
    def keep(component: ComponentType, sample: int) -> bool:
        lost = {ComponentType.MARKERS: {10, 11, 30}, ComponentType.ANALOG: {205, 206}}
        return sample not in lost.get(component, set())

    messages = [parameters(SCENE.parameters), *scene_messages(SCENE, 50, keep=keep)]
    job = export_messages(tmp_path, messages, "out.c3d")
    assert job.notes == [
        "out.c3d: 3 of 50 frames are missing in the take; they are empty",
        "out.c3d: 2 analog samples are missing in the take; they are NaN",
    ]
    content = read_ezc3d(tmp_path / "out.c3d")
    points = content["data"]["points"]
    assert np.flatnonzero(np.isnan(points[0]).all(axis=0)).tolist() == [10, 11, 30]
    recorded = SCENE.items(ComponentType.MARKERS, np.arange(50))
    assert np.array_equal(float32(points[0, :, 12]), recorded["x"][12], equal_nan=True)
    analog = float32(content["data"]["analogs"][0, :3])
    assert np.flatnonzero(np.isnan(analog).any(axis=0)).tolist() == [205, 206]
    assert np.array_equal(analog[:, 207], SCENE.items(ComponentType.ANALOG, np.array([207]))[0])


@pytest.mark.parametrize(
    ("analog_samples", "first", "last"),
    [(range(3, 497), 1, 49), (range(500), 0, 50), (range(27, 481), 3, 48), (range(100, 400), 10, 40)],
)
def test_frames_at_the_ends_without_analog_samples_are_left_out(
    tmp_path: Path, analog_samples: range, first: int, last: int
) -> None:
    def keep(component: ComponentType, sample: int) -> bool:
        return component is ComponentType.MARKERS or sample in analog_samples

    messages = [parameters(SCENE.parameters), *scene_messages(SCENE, 50, keep=keep)]
    job = export_messages(tmp_path, messages, "out.c3d")
    content = read_ezc3d(tmp_path / "out.c3d")
    frames = last - first
    assert content["data"]["points"].shape[2] == frames
    expected = SCENE.items(ComponentType.ANALOG, np.arange(10 * first, 10 * last)).T
    assert np.array_equal(float32(content["data"]["analogs"][0, :3]), expected)
    recorded = SCENE.items(ComponentType.MARKERS, np.array([first]))
    assert np.array_equal(float32(content["data"]["points"][0, :, 0]), recorded["x"][0], equal_nan=True)
    assert bool(job.notes) == (frames < 50)
    assert "frames at the ends were left out" in "".join(job.notes) or frames == 50


def test_analog_samples_beyond_the_markers_are_cut(tmp_path: Path) -> None:
    def keep(component: ComponentType, sample: int) -> bool:
        return component is not ComponentType.MARKERS or 5 <= sample < 45

    messages = [parameters(SCENE.parameters), *scene_messages(SCENE, 50, keep=keep)]
    export_messages(tmp_path, messages, "out.c3d")
    content = read_ezc3d(tmp_path / "out.c3d")
    expected = SCENE.items(ComponentType.ANALOG, np.arange(50, 450)).T
    assert np.array_equal(float32(content["data"]["analogs"][0, :3]), expected)
    assert content["data"]["points"].shape[2] == 40


def test_each_measurement_is_a_file(tmp_path: Path) -> None:
    messages = [
        description(),
        parameters(SCENE.parameters),
        *scene_messages(SCENE, 20),
        *scene_messages(SCENE, 30, start_us=60_000_000, sequence=10_000),  # a pause of a minute
    ]
    again = list(scene_messages(SCENE, 10, sequence=20_000))  # the server's time starts again
    shifted = [
        (
            channel,
            message[:8]
            + (int.from_bytes(message[8:16], "big") + 90_000_000).to_bytes(8, "big")
            + (int.from_bytes(message[16:24], "big") + 90_000_000).to_bytes(8, "big")
            + message[24:],
        )
        for channel, message in again
    ]
    job = export_messages(tmp_path, [*messages, *shifted], "walk.c3d")
    assert [path.name for path in job.files.paths] == ["walk-1.c3d", "walk-2.c3d", "walk-3.c3d"]
    assert job.notes == ["there are 3 measurements, so there are 3 files"]
    for path, count in zip(job.files.paths, (20, 30, 10), strict=True):
        content = read_ezc3d(path)
        assert content["data"]["points"].shape[2] == count
        expected = SCENE.items(ComponentType.ANALOG, np.arange(10 * count)).T
        assert np.array_equal(float32(content["data"]["analogs"][0, :3]), expected)


def test_each_set_of_labels_is_a_file(tmp_path: Path) -> None:
    renamed = replace(
        SCENE.parameters,
        markers=Parameters3D(100.0, "mm", tuple(Marker(str(n), f"new {n}") for n in range(5))),
    )
    messages = list(scene_messages(SCENE, 40))
    half = len(messages) // 2
    later = [
        (channel, message[:36] + (2).to_bytes(4, "big") + message[40:])
        for channel, message in messages[half:]
    ]
    job = export_messages(
        tmp_path, [parameters(SCENE.parameters), *messages[:half], parameters(renamed, 2), *later], "walk.c3d"
    )
    first, second = (read_ezc3d(path) for path in job.files.paths)
    assert second["parameters"]["POINT"]["LABELS"]["value"] == [f"new {n}" for n in range(5)]
    assert first["data"]["points"].shape[2] + second["data"]["points"].shape[2] == 40
    together = np.concatenate([first["data"]["analogs"], second["data"]["analogs"]], axis=2)[0, :3]
    assert np.array_equal(float32(together), SCENE.items(ComponentType.ANALOG, np.arange(400)).T)


def test_each_source_is_a_file(tmp_path: Path) -> None:
    messages = [
        description("left"),
        description("right"),
        parameters(SCENE.parameters, source="left"),
        parameters(SCENE.parameters, source="right"),
        *scene_messages(SCENE, 10, source="left"),
        *scene_messages(SCENE, 12, source="right"),
    ]
    job = export_messages(tmp_path, messages, "walk.c3d")
    assert [path.name for path in job.files.paths] == ["walk-left.c3d", "walk-right.c3d"]
    only = export_messages(tmp_path, messages, "one.c3d", source="right")
    assert [path.name for path in only.files.paths] == ["one.c3d"]
    assert read_ezc3d(tmp_path / "one.c3d")["data"]["points"].shape[2] == 12


def test_from_and_to_choose_a_part(tmp_path: Path) -> None:
    messages = [parameters(SCENE.parameters), *scene_messages(SCENE, 100)]
    export_messages(tmp_path, messages, "out.c3d", from_s=0.2, to_s=0.5)
    content = read_ezc3d(tmp_path / "out.c3d")
    assert content["data"]["points"].shape[2] in {29, 30, 31}


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


def test_frames_without_items_begin_no_new_measurement(tmp_path: Path) -> None:
    frames = [frame(ComponentType.MARKERS, [] if n % 5 == 2 else visible((n, 2, 3)), n) for n in range(20)]
    job = export_messages(tmp_path, [labelled("a"), *frames], "out.c3d")
    assert job.notes == ["out.c3d: 4 of 20 frames are missing in the take; they are empty"]
    content = read_independently(tmp_path / "out.c3d")
    assert content.is_visible[:, 0].tolist() == [n % 5 != 2 for n in range(20)]
    assert content.points[3, 0, 0] == 3


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


def stepped(message: Message, step_us: int) -> Message:
    """Return a message whose times on the gateway's clock are later by a step."""
    channel, data = message
    utime, capture_utime = (int.from_bytes(data[at : at + 8], "big") + step_us for at in (8, 16))
    return channel, data[:8] + utime.to_bytes(8, "big") + capture_utime.to_bytes(8, "big") + data[24:]


@pytest.mark.parametrize("step_us", [-3_600_000_000, -50_000, 3_600_000_000])
def test_a_step_of_the_clock_changes_nothing(tmp_path: Path, step_us: int) -> None:
    messages = list(scene_messages(SCENE, 100))
    half = len(messages) // 2
    later = [stepped(message, step_us) for message in messages[half:]]
    job = export_messages(
        tmp_path, [description(), parameters(SCENE.parameters), *messages[:half], *later], "out.c3d"
    )
    assert job.notes == []
    content = read_ezc3d(tmp_path / "out.c3d")
    recorded = SCENE.items(ComponentType.MARKERS, np.arange(100))
    assert np.array_equal(float32(content["data"]["points"][0]), recorded["x"].T, equal_nan=True)
    expected = SCENE.items(ComponentType.ANALOG, np.arange(1000)).T
    assert np.array_equal(float32(content["data"]["analogs"][0, :3]), expected)


def test_a_new_session_of_one_stream_keeps_the_samples_of_the_other(tmp_path: Path) -> None:
    messages = []
    for channel, data in scene_messages(SCENE, 100):
        is_later = int.from_bytes(data[24:32], "big") >= 40
        session = 2 if channel.endswith("3D") and is_later else 1
        messages.append((channel, data[:32] + session.to_bytes(4, "big") + data[36:]))
    job = export_messages(tmp_path, [parameters(SCENE.parameters), *messages], "out.c3d")
    files = [read_ezc3d(path)["data"] for path in job.files.paths]
    assert [file["points"].shape[2] for file in files] == [40, 60]
    together = np.concatenate([file["analogs"] for file in files], axis=2)[0, :3]
    assert np.array_equal(float32(together), SCENE.items(ComponentType.ANALOG, np.arange(1000)).T)


def test_time_stamps_that_do_not_progress(tmp_path: Path) -> None:
    lost = {12, 13}
    messages = [
        (channel, data[:44] + bytes(8) + data[52:])
        for channel, data in scene_messages(SCENE, 60)
        if not (channel.endswith("3D") and int.from_bytes(data[24:32], "big") in lost)
    ]
    export_messages(tmp_path, [description(), parameters(SCENE.parameters), *messages], "out.c3d")
    content = read_ezc3d(tmp_path / "out.c3d")["data"]
    points = float32(content["points"][0])
    empty = np.flatnonzero(np.isnan(points).all(axis=0)).tolist()
    left_out = 12 - empty[0]  # at the beginning: the times of capture decide, which have a jitter
    assert left_out in {0, 1}
    assert empty == [12 - left_out, 13 - left_out]
    recorded = float32(SCENE.items(ComponentType.MARKERS, np.arange(60))["x"].T)
    assert np.array_equal(points[:, 20 - left_out], recorded[:, 20], equal_nan=True)


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


def test_measurements_without_a_pause_keep_their_own_samples(tmp_path: Path) -> None:
    other = SyntheticScene(markers=5, tools=0, analog=3, plates=2, rate_hz=100, analog_rate_hz=1000, seed=9)
    second = [stepped(message, 1_010_000) for message in scene_messages(other, 120, sequence=5000)]
    job = export_messages(
        tmp_path, [parameters(SCENE.parameters), *scene_messages(SCENE, 100), *second], "walk.c3d"
    )
    files = [read_ezc3d(path)["data"] for path in job.files.paths]
    for file, scene, count in zip(files, (SCENE, other), (1000, 1200), strict=True):
        expected = scene.items(ComponentType.ANALOG, np.arange(count)).T
        assert np.array_equal(float32(file["analogs"][0, :3]), expected)
