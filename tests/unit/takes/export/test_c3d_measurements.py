"""Measurements, gaps and steps of clocks in exported C3D files."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Marker, Parameters3D
from gateway.simulator.synthetic import SyntheticScene
from gateway.takes.export.job import ExportJob
from tests.support.errors import each_names, names, one_names
from tests.support.takes import Message, description, frame, parameters, scene_messages
from tests.unit.takes.export.exported import (
    SCENE,
    C3d,
    export_c3d,
    export_messages,
    float32,
    labelled,
    notes_of,
    read_independently,
    samples,
    scene,
)


def export_all(folder: Path, messages: Iterable[Message], **options: Any) -> tuple[ExportJob, list[C3d]]:
    """Export to walk.c3d; return the job and its files."""
    job = export_messages(folder, messages, "walk.c3d", **options)
    return job, [C3d(path) for path in job.files.paths]


def x_of(first: int, last: int) -> Any:
    """Return the x of the scene's markers, of shape (markers, frames)."""
    return float32(SCENE.items(ComponentType.MARKERS, np.arange(first, last))["x"].T)


def later(message: Message, step_us: int) -> Message:
    """Return a message whose times on the gateway's clock are later by a step."""
    channel, data = message
    times = (int.from_bytes(data[at : at + 8], "big") + step_us for at in (8, 16))
    return channel, data[:8] + b"".join(time_us.to_bytes(8, "big") for time_us in times) + data[24:]


def test_lost_frames_are_empty_and_the_others_keep_their_places(tmp_path: Path) -> None:
    lost = {ComponentType.MARKERS: {10, 11, 30}, ComponentType.ANALOG: {205, 206}}
    found, notes = export_c3d(tmp_path, scene(50, keep=lambda key, number: number not in lost.get(key, ())))
    assert each_names(
        notes,
        ["out.c3d", "frames", "3 of 50"],
        ["out.c3d", "analog samples", 2],
        ["out.c3d", "forces", "analog", 2],
    )
    assert np.flatnonzero(np.isnan(found.points[0]).all(axis=0)).tolist() == [10, 11, 30]
    assert np.array_equal(found.points[0, :, 12:13], x_of(12, 13), equal_nan=True)
    assert np.flatnonzero(np.isnan(found.analog[:3]).any(axis=0)).tolist() == [205, 206]
    assert np.array_equal(found.analog[:3, 207:208], samples(207, 208))


@pytest.mark.parametrize(
    ("markers", "analog", "first", "last"),
    [
        (range(50), range(3, 497), 1, 49),
        (range(50), range(500), 0, 50),
        (range(50), range(27, 481), 3, 48),
        (range(50), range(100, 400), 10, 40),
        (range(5, 45), range(500), 5, 45),
    ],
)
def test_what_markers_and_analog_do_not_both_have_at_the_ends_is_left_out(
    tmp_path: Path, markers: range, analog: range, first: int, last: int
) -> None:
    def keep(component: ComponentType, sample: int) -> bool:
        return sample in (markers if component is ComponentType.MARKERS else analog)

    found, notes = export_c3d(tmp_path, scene(50, keep=keep))
    assert found.points.shape[2] == last - first
    assert np.array_equal(found.analog[:3], samples(10 * first, 10 * last))
    assert np.array_equal(found.points[0], x_of(first, last), equal_nan=True)
    assert one_names(notes, "frames", "ends") == (last - first < len(markers))
    count, total = len(analog) - 10 * (last - first), len(analog)
    left_out = f"rows of analog of lab that are in no file | {count} of {total}"
    assert (left_out in notes) == (count > 0)


def test_each_measurement_is_a_file(tmp_path: Path) -> None:
    messages = [
        *(description(), *scene(20)),
        *scene_messages(SCENE, 30, start_us=60_000_000, sequence=10_000),  # a pause of a minute
        # The server's time starts again.
        *(later(message, 90_000_000) for message in scene_messages(SCENE, 10, sequence=20_000)),
    ]
    job, files = export_all(tmp_path, messages)
    assert [path.name for path in job.files.paths] == ["walk-1.c3d", "walk-2.c3d", "walk-3.c3d"]
    assert names(notes_of(job)[0], "measurements", 3)
    for found, count in zip(files, (20, 30, 10), strict=True):
        assert found.points.shape[2] == count
        assert np.array_equal(found.analog[:3], samples(0, 10 * count))


def test_each_set_of_labels_is_a_file(tmp_path: Path) -> None:
    labels = [f"new {n}" for n in range(5)]
    markers = Parameters3D(100.0, "mm", tuple(Marker("", label) for label in labels))
    first, *messages = scene(40)
    half = len(messages) // 2
    second = [(channel, data[:36] + (2).to_bytes(4, "big") + data[40:]) for channel, data in messages[half:]]
    renamed = parameters(replace(SCENE.parameters, markers=markers), 2)
    _, files = export_all(tmp_path, [first, *messages[:half], renamed, *second])
    assert files[1]("POINT", "LABELS") == labels
    assert sum(found.points.shape[2] for found in files) == 40
    assert np.array_equal(np.concatenate([found.analog for found in files], axis=1)[:3], samples(0, 400))


def test_frames_without_items_begin_no_new_measurement(tmp_path: Path) -> None:
    frames = [frame(ComponentType.MARKERS, [] if n % 5 == 2 else [(n, 2, 3, 0)], n) for n in range(20)]
    _, notes = export_c3d(tmp_path, [labelled("a"), *frames])
    assert each_names(notes, ["out.c3d", "frames", "4 of 20"])
    content = read_independently(tmp_path / "out.c3d")
    assert content.is_visible[:, 0].tolist() == [n % 5 != 2 for n in range(20)]
    assert content.points[3, 0, 0] == 3


@pytest.mark.parametrize("step_us", [-3_600_000_000, -50_000, 3_600_000_000])
def test_a_step_of_the_clock_changes_nothing(tmp_path: Path, step_us: int) -> None:
    messages = scene(100)
    half = len(messages) // 2
    messages[half:] = [later(message, step_us) for message in messages[half:]]
    found, notes = export_c3d(tmp_path, [description(), *messages])
    notes = [note for note in notes if "the last row of" not in note]
    assert each_names(notes, ["out.c3d", "forces", "analog", 2])
    assert np.array_equal(found.points[0], x_of(0, 100), equal_nan=True)
    assert np.array_equal(found.analog[:3], samples(0, 1000))


def test_a_new_session_of_one_stream_keeps_the_samples_of_the_other(tmp_path: Path) -> None:
    first, *messages = scene(100)
    for number, (channel, data) in enumerate(messages):
        if channel.endswith("3D") and int.from_bytes(data[24:32], "big") >= 40:
            messages[number] = (channel, data[:32] + (2).to_bytes(4, "big") + data[36:])
    _, files = export_all(tmp_path, [first, *messages])
    assert [found.points.shape[2] for found in files] == [40, 60]
    assert np.array_equal(np.concatenate([found.analog for found in files], axis=1)[:3], samples(0, 1000))


def test_time_stamps_that_do_not_progress(tmp_path: Path) -> None:
    first, *messages = scene(60, keep=lambda key, number: key.key != "3d" or number not in {12, 13})
    messages = [(channel, data[:44] + bytes(8) + data[52:]) for channel, data in messages]
    found, _ = export_c3d(tmp_path, [description(), first, *messages])
    empty = np.flatnonzero(np.isnan(found.points[0]).all(axis=0)).tolist()
    left_out = 12 - empty[0]  # at the beginning: the times of capture decide, which have a jitter
    assert left_out in {0, 1}
    assert empty == [12 - left_out, 13 - left_out]
    shown = 20 - left_out
    assert np.array_equal(found.points[0, :, shown : shown + 1], x_of(20, 21), equal_nan=True)


def test_measurements_without_a_pause_keep_their_own_samples(tmp_path: Path) -> None:
    other = SyntheticScene(markers=5, tools=0, analog=3, plates=2, rate_hz=100, analog_rate_hz=1000, seed=9)
    second = [later(message, 1_010_000) for message in scene_messages(other, 120, sequence=5000)]
    _, files = export_all(tmp_path, [*scene(100), *second])
    for found, shown, count in zip(files, (SCENE, other), (1000, 1200), strict=True):
        assert np.array_equal(found.analog[:3], samples(0, count, shown))
