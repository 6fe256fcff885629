"""What several formats have in common: files, times, memory, and takes without anything to export."""

import csv
import errno
import math
import os
import re
from datetime import datetime
from pathlib import Path

import pytest

from gateway.errors import TakeError
from gateway.rtc3d.components import ComponentType
from gateway.takes.export.job import TakePart
from gateway.takes.files import component_rows, spool
from tests.support.errors import raises
from tests.support.takes import (
    START_UTIME,
    Message,
    description,
    frame,
    markers,
    parameters,
    scene_messages,
)
from tests.unit.takes.export.exported import SCENE, C3d, export_messages, labelled, notes_of
from tests.unit.takes.export.test_trc import read_trc

ANALOG = frame(ComponentType.ANALOG, [1, 2])
EVENT = frame(ComponentType.EVENT, [(1, 2, -1, -1, -1)])


@pytest.mark.parametrize(
    ("extension", "messages", "part", "problem"),
    [
        (".c3d", [EVENT], TakePart(), r"no markers, analog channels or forces, .*\.c3d"),
        (".trc", [ANALOG], TakePart(), r"take\.lcmlog .*no markers, .*\.trc"),
        (".trc", [markers(1)], TakePart(from_s=5.0), "no markers .*--from"),
        (".csv", [description(), labelled("a")], TakePart(), "has no frames"),
        (".csv", [markers(1)], TakePart(from_s=math.inf), "no frames .*--from"),
        (".sto", [frame(ComponentType.ANALOG, [])], TakePart(), "has no analog channels"),
        (
            ".csv",
            [description(), markers(1)],
            TakePart("studio"),
            "no source 'studio'; its sources are: lab",
        ),
        (".mcap", [description(), labelled("a")], TakePart(), "has no frames"),
        (".mcap", [description(), labelled("a")], TakePart(None, 0.0, 1.0), "has no frames"),
    ],
)
def test_a_take_without_anything_to_export_is_an_error(
    tmp_path: Path, extension: str, messages: list[tuple[str, bytes]], part: TakePart, problem: str
) -> None:
    with pytest.raises(TakeError, match=problem):
        export_messages(tmp_path, messages, f"walk{extension}", part=part)
    assert [path.name for path in tmp_path.iterdir()] == ["take.lcmlog"]


BEGIN = "2023-11-14T22:13:20"  # START_UTIME
OFFSET_S = 2.5
"""From the beginning of the take to the first frame, with the 3 ms that a frame takes to arrive."""


def messages() -> list[Message]:
    """Return a take whose frames begin 2.5 s after its first message; the first has a time 40 ms too late.

    Analog begins 0.5 s later, so a C3D file does.
    """

    def keep(component: ComponentType, sample: int) -> bool:
        return component is ComponentType.MARKERS or (component is ComponentType.ANALOG and sample >= 500)

    first, *others = scene_messages(SCENE, 300, start_us=2_499_000, keep=keep)
    late = (int.from_bytes(first[1][16:24], "big") + 40_000).to_bytes(8, "big")
    return [
        description(),
        parameters(SCENE.parameters),
        (first[0], first[1][:16] + late + first[1][24:]),
        *others,
    ]


def test_trc_and_csv_count_from_the_beginning_of_the_take(tmp_path: Path) -> None:
    export_messages(tmp_path, messages(), "walk.trc")
    export_messages(tmp_path, messages(), "walk.csv")
    with (tmp_path / "walk-3d.csv").open() as file:
        rows = list(csv.DictReader(file))
    expected_s = [float(row["time_s"]) for row in rows]
    found_s = read_trc(tmp_path / "walk.trc").times_s
    assert found_s[0] == pytest.approx(OFFSET_S, abs=0.001)
    assert found_s[1:] == pytest.approx(expected_s[1:], abs=0.001)
    assert {round(float(row["capture_utime"]) - 1e6 * float(row["time_s"])) for row in rows} == {START_UTIME}
    head = (tmp_path / "walk.trc").read_text().splitlines()[0].split("\t")
    assert head[3] == f"walk.trc time_0={BEGIN}.000000Z"


@pytest.mark.parametrize(("from_s", "first"), [(None, OFFSET_S + 0.5), (4.0, 4.0)])
def test_a_c3d_file_counts_from_its_first_frame_and_says_when_that_was(
    tmp_path: Path, from_s: float | None, first: float
) -> None:
    notes = notes_of(export_messages(tmp_path, messages(), "walk.c3d", part=TakePart(from_s=from_s)))
    found = C3d(tmp_path / "walk.c3d")
    assert found("TRIAL", "TIME_OFFSET") == pytest.approx([first], abs=0.01)
    [text] = found("TRIAL", "DATE_TIME")
    later = datetime.fromisoformat(text) - datetime.fromisoformat(f"{BEGIN}Z")
    assert later.total_seconds() == pytest.approx(first, abs=0.01)
    pattern = rf"walk\.c3d \| time 0 is the first frame, {text} \| {first:.1f}\d\d s after the beginning"
    assert sum(bool(re.fullmatch(pattern, note)) for note in notes) == 1


@pytest.mark.parametrize("extension", [".c3d", ".trc"])
def test_a_take_that_does_not_fit_into_memory_becomes_the_same_file(
    tmp_path: Path, extension: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames are missing, overtaken and repeated, a measurement begins anew, and labels change."""
    described = parameters(SCENE.parameters)
    frames = [described, *scene_messages(SCENE, 120)]
    del frames[200:210]
    frames[50], frames[60] = frames[60], frames[50]
    frames += [*frames[400:420], labelled("a", "b", version=2)]
    frames += [markers(2, 5000 + number, version=2, timestamp_us=number * 10_000) for number in range(40)]
    in_memory = export_messages(tmp_path, frames, f"memory{extension}")
    monkeypatch.setattr(component_rows, "_IN_MEMORY_BYTES", 100)
    monkeypatch.setattr(spool, "_PIECE_ROWS", 7)
    on_disk = export_messages(tmp_path, frames, f"memory2{extension}")
    assert len(in_memory.files.paths) > 1
    for expected, found in zip(in_memory.files.paths, on_disk.files.paths, strict=True):
        assert found.read_bytes() == expected.read_bytes().replace(b"memory", b"memory2")
    named = [note._replace(file=note.file.replace("memory2", "memory")) for note in on_disk.notes]
    assert named == in_memory.notes


def test_a_full_disk_for_what_does_not_fit_into_memory_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(component_rows, "_IN_MEMORY_BYTES", 100)
    with Path("/dev/full").open("wb", buffering=0) as full:
        monkeypatch.setattr(component_rows, "spool_file", lambda _folder: full)
        with raises(TakeError, "temporary", os.strerror(errno.ENOSPC)):
            export_messages(tmp_path, messages(), "walk.trc")
    assert [path.name for path in tmp_path.iterdir()] == ["take.lcmlog"]
