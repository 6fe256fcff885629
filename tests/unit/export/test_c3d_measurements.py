"""Measurements, gaps and steps of clocks in exported C3D files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Marker, Parameters3D
from gateway.simulator.synthetic import SyntheticScene
from tests.recorded_scenes import scene_messages
from tests.takes import Message, description, frame, parameters
from tests.unit.export.c3d_takes import SCENE, float32, labelled, visible
from tests.unit.export.exported import export_messages, read_ezc3d, read_independently


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


def test_frames_without_items_begin_no_new_measurement(tmp_path: Path) -> None:
    frames = [frame(ComponentType.MARKERS, [] if n % 5 == 2 else visible((n, 2, 3)), n) for n in range(20)]
    job = export_messages(tmp_path, [labelled("a"), *frames], "out.c3d")
    assert job.notes == ["out.c3d: 4 of 20 frames are missing in the take; they are empty"]
    content = read_independently(tmp_path / "out.c3d")
    assert content.is_visible[:, 0].tolist() == [n % 5 != 2 for n in range(20)]
    assert content.points[3, 0, 0] == 3


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
