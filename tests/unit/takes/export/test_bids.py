"""Export to Motion-BIDS: values, channels, runs and events; the official validator has a test of its own.

numpy reads the values back. What the names of files and columns mean is in the specification of BIDS.
"""

import csv
import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from gateway.errors import SelectionError, TakeError
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import ForceChannel, Parameters, ParametersForce, Plate
from gateway.simulator.c3d_scene import C3dScene
from gateway.simulator.synthetic import SyntheticScene
from gateway.takes.export.job import BidsNames, ExportJob, TakePart
from gateway.takes.files.new_file import NewFiles
from tests.support.errors import names, one_names, raises
from tests.support.takes import (
    START_UTIME,
    Message,
    description,
    details,
    frame,
    markers,
    parameters,
    scene_messages,
)
from tests.unit.takes.export.exported import NAN, export_messages, float32, labelled, notes_of

SCENE = SyntheticScene(markers=3, tools=2, analog=3, plates=2, rate_hz=100, analog_rate_hz=1000, seed=5)
Scene = C3dScene | SyntheticScene
NAMES = BidsNames(task="walking")


def export(
    folder: Path,
    messages: Sequence[Message],
    names: BidsNames = NAMES,
    *,
    subject: str = "01",
    **options: Any,
) -> ExportJob:
    """Export to a data set; ``subject`` is not that of the take, unless it is ""."""
    about = {"subject": subject} if subject else {}
    return export_messages(folder, messages, "study", format="bids", bids=names, details=about, **options)


def only(folder: Path, pattern: str) -> Path:
    [path] = folder.rglob(pattern)
    return path


def table(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file, delimiter="\t", quoting=csv.QUOTE_NONE))


def column(path: Path, name: str) -> list[str]:
    return [row[name] for row in table(path)]


def read_motion(path: Path) -> npt.NDArray[np.float64]:
    """Return the values of a file, shape (samples, channels); NaN where it has n/a."""
    return np.genfromtxt(path, delimiter="\t", missing_values="n/a", filling_values=NAN, ndmin=2)


def recorded(scene: Scene, component: ComponentType, count: int) -> Any:
    """Return the items of a scene as 32-bit floats, shape (samples, fields of all items)."""
    items = scene.items(component, np.arange(count))
    names = items.dtype.names
    fields = items if names is None else np.stack([items[name] for name in names], axis=2)
    return float32(fields).reshape(count, -1)


KEYS = {"Markers": ComponentType.MARKERS, "Tools": ComponentType.TOOLS}
KEYS |= {"Analog": ComponentType.ANALOG, "Forces": ComponentType.FORCE}


IN_MM = {"Markers": [True] * 4, "Tools": [False] * 4 + [True] * 4, "Analog": [False], "Forces": [False] * 6}
"""Which fields of an item the server sends in mm, or in Nmm."""


def assert_values(
    folder: Path, scene: Scene, name: str, num_samples: int, in_mm: list[bool], lost: Sequence[int] = ()
) -> None:
    """Check that a file has the recorded values exactly, also after the conversion from mm."""
    found = read_motion(only(folder, f"*_tracksys-lab{name}_run-1_motion.tsv"))
    found *= np.where(np.resize(in_mm, found.shape[1]), 1000.0, 1.0)
    expected = recorded(scene, KEYS[name], num_samples)
    expected[[*lost]] = NAN
    assert np.array_equal(float32(found), expected, equal_nan=True), name


def test_all_values_survive_and_lost_frames_are_not_available(tmp_path: Path) -> None:
    lost = [4, 5, 20]

    def keep(component: ComponentType, sample: int) -> bool:
        return component is not ComponentType.MARKERS or sample not in lost

    job = export(tmp_path, [parameters(SCENE.parameters), *scene_messages(SCENE, 40, keep=keep)])
    assert_values(tmp_path, SCENE, "Markers", 40, IN_MM["Markers"], lost)
    assert_values(tmp_path, SCENE, "Tools", 40, IN_MM["Tools"])
    assert_values(tmp_path, SCENE, "Analog", 400, IN_MM["Analog"])
    assert_values(tmp_path, SCENE, "Forces", 400, IN_MM["Forces"])
    file = "sub-01_task-walking_tracksys-labMarkers_run-1_motion.tsv"
    assert (file, "3 of 40") in [(note.file, note.amount) for note in job.notes]
    assert one_names(notes_of(job, usual=True), "mm to m")


@pytest.mark.takes
@pytest.mark.parametrize(
    ("name", "samples"),
    [("qualisys", {"Markers": 340, "Analog": 3400, "Forces": 3400}), ("optotrak", {"Markers": 29})],
)
def test_the_values_of_real_recordings_survive(tmp_path: Path, name: str, samples: dict[str, int]) -> None:
    scene = C3dScene(Path(os.environ["RTC3D_TAKES"]) / f"{name}.c3d")
    export(tmp_path, [parameters(scene.parameters), *scene_messages(scene, samples["Markers"])])
    in_mm = IN_MM | {"Forces": [False] * 3 + [True] * 3}  # moments are in Nmm
    for each, count in samples.items():
        assert_values(tmp_path, scene, each, count, in_mm[each])


def test_channels_and_sidecars_describe_the_columns(tmp_path: Path) -> None:
    export(tmp_path, [parameters(SCENE.parameters), *scene_messages(SCENE, 20), details(note="left knee")])
    first_item = {
        "Markers": [("x", "POS", "m"), ("y", "POS", "m"), ("z", "POS", "m"), ("n/a", "MISC", "m")],
        "Tools": [
            *((f"quat_{axis}", "ORNT", "n/a") for axis in "wxyz"),
            *((axis, "POS", "m") for axis in "xyz"),
            ("n/a", "MISC", "m"),
        ],
        "Analog": [("n/a", "MISC", "mV")],
        "Forces": [*((axis, "MISC", "N") for axis in "xyz"), *((axis, "MISC", "N.m") for axis in "xyz")],
    }
    for name, expected in first_item.items():
        channels = table(only(tmp_path, f"*_tracksys-lab{name}_run-1_channels.tsv"))
        described = [(row["component"], row["type"], row["units"]) for row in channels]
        assert described[: len(expected)] == expected
        assert len({row["name"] for row in channels}) == len(channels)
        motion = only(tmp_path, f"*_tracksys-lab{name}_run-1_motion.tsv")
        sidecar = json.loads(motion.with_suffix(".json").read_text())
        assert sidecar["MotionChannelCount"] == len(channels) == read_motion(motion).shape[1]
        for kind in ("POS", "ORNT", "MISC"):
            assert sidecar[f"{kind}ChannelCount"] == [row["type"] for row in channels].count(kind)
        rate_hz = 100 if name in ("Markers", "Tools") else 1000
        assert sidecar["SamplingFrequency"] == rate_hz
        assert sidecar["SamplingFrequencyEffective"] == pytest.approx(rate_hz, rel=0.01)
        assert {row["sampling_frequency"] for row in channels} == {f"{rate_hz:.1f}"}
        assert sidecar["RecordingDuration"] == pytest.approx(0.2)
        assert sidecar["Note"] == "left knee"
        points = {row["tracked_point"] for row in channels} - {"n/a"}
        assert sidecar["TrackedPointsCount"] == len(points)
        frames = {row["reference_frame"] for row in channels if row["component"] != "n/a"}
        assert frames == (set() if name == "Analog" else {"lab"})
    plates = json.loads(only(tmp_path, "*labForces*_motion.json").read_text())["ForcePlates"]
    corner = SCENE.parameters.force.plates[1].corners[2] if SCENE.parameters.force else None
    assert corner is not None
    assert plates[1]["Corners"][2] == pytest.approx([corner.x / 1000, corner.y / 1000, corner.z / 1000])


def test_other_units_become_si_units(tmp_path: Path) -> None:
    units = ["kN"] * 3 + ["Nmm"] * 3
    channels = tuple(ForceChannel(str(n), "", unit) for n, unit in enumerate(units))
    force = Parameters(force=ParametersForce((Plate("1", "", channels=channels),)))
    messages = [parameters(force), frame(ComponentType.FORCE, [(1, 2, 3, 4, 5, 6)])]
    job = export(tmp_path, messages)
    path = only(tmp_path, "*_motion.tsv")
    assert read_motion(path)[0] == pytest.approx([1000, 2000, 3000, 0.004, 0.005, 0.006])
    assert one_names(notes_of(job), "forces", "N.m")


def test_a_component_without_items_is_no_tracking_system(tmp_path: Path) -> None:
    """Servers send 6D frames also if no tool is defined."""
    export(tmp_path, [markers(1), frame(ComponentType.TOOLS, [])])
    assert runs_of(tmp_path) == {("labMarkers", "1")}


def test_a_plate_that_sends_nothing_has_no_channels(tmp_path: Path) -> None:
    export(tmp_path, [parameters(SCENE.parameters), frame(ComponentType.FORCE, [(1, 2, 3, 4, 5, 6)])])
    assert len(table(only(tmp_path, "*_channels.tsv"))) == 6


def test_an_unknown_unit_of_length_stays_and_is_reported(tmp_path: Path) -> None:
    job = export(tmp_path, [labelled("a", unit="cubit"), frame(ComponentType.MARKERS, [(1, 2, 3, 0)])])
    assert read_motion(only(tmp_path, "*_motion.tsv")).tolist() == [[1, 2, 3, 0]]
    assert set(column(only(tmp_path, "*_channels.tsv"), "units")) == {"cubit"}
    assert names(notes_of(job)[-1], "'cubit'")


def test_labels_cannot_break_the_tables(tmp_path: Path) -> None:
    job = export(tmp_path, [labelled("a\tb", ""), frame(ComponentType.MARKERS, [(1, 2, 3, 0)] * 2)])
    rows = table(only(tmp_path, "*_channels.tsv"))
    assert [row["name"] for row in rows[::4]] == ["a_b_x", "marker 2_x"]
    assert {row["tracked_point"] for row in rows} == {"a_b", "marker 2"}
    assert one_names(notes_of(job), "labels of markers", "a_b", 1)


def runs_of(folder: Path) -> set[tuple[str, str]]:
    """Return the tracking system and the run of each motion file."""
    parts = [path.name.split("_") for path in folder.rglob("*_motion.tsv")]
    return {(name[2].removeprefix("tracksys-"), name[3].removeprefix("run-")) for name in parts}


def test_what_sources_record_at_the_same_time_is_one_run(tmp_path: Path) -> None:
    messages = [
        *(markers(1, number, source=source) for number in range(5) for source in ("lab-a", "lab-b")),
        *(markers(1, number, source="lab-a", session=2) for number in range(100, 105)),
    ]
    job = export(tmp_path, messages)
    assert runs_of(tmp_path) == {("labaMarkers", "1"), ("labbMarkers", "1"), ("labaMarkers", "2")}
    scans = table(only(tmp_path, "sub-01_scans.tsv"))
    times = {row["filename"].split("tracksys-")[1]: row["acq_time"] for row in scans}
    assert times["labaMarkers_run-1_motion.tsv"] == times["labbMarkers_run-1_motion.tsv"]
    assert times["labaMarkers_run-1_motion.tsv"] == "2023-11-14T22:13:19.998000Z"
    assert times["labaMarkers_run-2_motion.tsv"] == "2023-11-14T22:13:20.998000Z"
    assert one_names(notes_of(job), "2 measurements", "2 runs")


def test_sources_whose_names_have_equal_letters_are_different_tracking_systems(tmp_path: Path) -> None:
    names = ("a12", "a1", "a_1")
    export(tmp_path, [markers(1, number, source=name) for number in range(5) for name in names])
    assert runs_of(tmp_path) == {("a12Markers", "1"), ("a1Markers", "1"), ("a122Markers", "1")}


def test_new_labels_begin_a_run_while_other_components_go_on(tmp_path: Path) -> None:
    """One motion file has one set of channels; the samples of analog channels must not be in two files."""
    analog = [frame(ComponentType.ANALOG, [number], number) for number in range(20)]
    before = [markers(1, number) for number in range(8)]
    after = [markers(2, number, version=2) for number in range(8, 20)]
    export(tmp_path, [labelled("a"), labelled("a", "b", version=2), *analog, *before, *after])
    assert runs_of(tmp_path) == {("labAnalog", "1"), ("labMarkers", "1"), ("labMarkers", "2")}
    assert len(read_motion(only(tmp_path, "*labAnalog*_motion.tsv"))) == 20


def test_components_whose_ends_overlap_by_a_jitter_are_of_different_runs(tmp_path: Path) -> None:
    """The first frame of a measurement can be captured before the last sample of the one before it."""
    first = [markers(1, number) for number in range(50)]
    tools = [(1, 0, 0, 0, number, 0, 0, 0) for number in range(50)]
    start = START_UTIME + 495_000
    second = [
        frame(ComponentType.TOOLS, [tool], number, utime=start + number * 10_000, session=2)
        for number, tool in enumerate(tools)
    ]
    export(tmp_path, [*first, *second])
    assert runs_of(tmp_path) == {("labMarkers", "1"), ("labTools", "2")}


def test_runs_are_numbered_in_the_order_of_time(tmp_path: Path) -> None:
    """The sources are in the order of their first messages, which can be parameters."""
    messages = [description("later"), *(markers(1, number, source="first") for number in range(5))]
    export(tmp_path, [*messages, *(markers(1, number, source="later") for number in range(100, 105))])
    assert runs_of(tmp_path) == {("firstMarkers", "1"), ("laterMarkers", "2")}


def event(number: int, timestamp_us: int) -> Message:
    item = (number, timestamp_us, -1, -1, -1)
    return frame(ComponentType.EVENT, [item], timestamp_us // 10_000, timestamp_us=timestamp_us)


def events_of(folder: Path, name: str) -> list[tuple[str, str]]:
    """Return onsets and labels of the events of a file."""
    return [(row["onset"], row["trial_type"]) for row in table(only(folder, f"*_{name}_events.tsv"))]


def test_events_count_from_the_first_sample_of_their_run(tmp_path: Path) -> None:
    measured = [markers(1, number) for number in [*range(10, 60), *range(2010, 2060)]]
    events = [event(7, 20_300_000), event(8, 400_000), event(5, 300_000), event(6, 10_000_000)]
    job = export(tmp_path, [*measured, *events])
    assert events_of(tmp_path, "tracksys-labMarkers_run-1") == [
        ("0.200000", "event 5"),
        ("0.300000", "event 8"),
    ]
    assert events_of(tmp_path, "tracksys-labMarkers_run-2") == [("0.200000", "event 7")]
    assert {*column(only(tmp_path, "*_run-2_events.tsv"), "value")} == {"7"}
    assert one_names(notes_of(job), "events of lab", 1)


def test_an_event_is_in_the_nearest_run_only_beside_the_markers(tmp_path: Path) -> None:
    """An event within 1 s of a measurement belongs to it, unless it is in another one."""
    analog = [frame(ComponentType.ANALOG, [number], number) for number in range(20)]
    before = [markers(1, number) for number in range(5, 20)]
    after = [markers(2, number, version=2) for number in range(20, 40)]
    described = [labelled("a"), labelled("a", "b", version=2)]
    export(
        tmp_path,
        [*described, *analog, *before, *after, event(1, 100_000), event(2, 250_000), event(3, 900_000)],
    )
    assert events_of(tmp_path, "tracksys-labMarkers_run-1") == [("0.050000", "event 1")]
    assert events_of(tmp_path, "run-2") == [("0.050000", "event 2"), ("0.700000", "event 3")]


def test_subject_and_session_come_from_the_take_in_letters_and_digits(tmp_path: Path) -> None:
    about = [details("S-01", "base line"), markers(1)]
    job = export(tmp_path, about, BidsNames(task="heel-toe"), subject="")
    assert only(tmp_path, "*_motion.tsv").relative_to(tmp_path).as_posix() == (
        "study/sub-S01/ses-baseline/motion/sub-S01_ses-baseline_task-heeltoe_tracksys-labMarkers_run-1_motion.tsv"
    )
    assert only(tmp_path, "*_scans.tsv").parent.name == "ses-baseline"
    for note in ("the subject 'S-01' is called 'S01'", "the task 'heel-toe' is called 'heeltoe'"):
        assert any(each.startswith(note) for each in notes_of(job))


@pytest.mark.parametrize(("subject", "task", "missing"), [("", "rest", "subject"), ("01", "", "task")])
def test_a_data_set_needs_a_subject_and_a_task(tmp_path: Path, subject: str, task: str, missing: str) -> None:
    problem = f"does not say the {missing}, and BIDS needs it; add --{missing}"
    with pytest.raises(SelectionError, match=problem):
        export(tmp_path, [markers(1)], BidsNames(task), subject=subject)
    assert [path.name for path in tmp_path.iterdir()] == ["take.lcmlog"]


@pytest.mark.parametrize("name", ["subject", "session", "task"])
def test_a_name_without_latin_letters_or_digits_is_an_error(tmp_path: Path, name: str) -> None:
    about = {"subject": "01", "session": "2", "task": "rest", name: "歩行"}
    problem = f"the {name} '歩行' has no letter from A to Z and no digit, as BIDS needs; choose by --{name}"
    with pytest.raises(SelectionError, match=problem):
        export(
            tmp_path,
            [details(session=about["session"]), markers(1)],
            BidsNames(about["task"]),
            subject=about["subject"],
        )


def test_sources_with_different_subjects_need_a_choice(tmp_path: Path) -> None:
    messages = [details(name, source=name) for name in ("a", "b")]
    messages += [markers(1, source=name) for name in ("a", "b")]
    with raises(SelectionError, "a and b", "--subject"):
        export(tmp_path, messages, subject="")
    export(tmp_path, messages, subject="", part=TakePart("b"))
    assert (tmp_path / "study/sub-b").is_dir()


def test_a_source_whose_name_bids_cannot_have_is_reported(tmp_path: Path) -> None:
    job = export(tmp_path, [description("lab-2"), markers(1, source="lab-2")])
    assert runs_of(tmp_path) == {("lab2Markers", "1")}
    assert one_names(notes_of(job), "'lab-2'", "'lab2'")


def test_a_data_set_grows_and_keeps_what_others_wrote(tmp_path: Path) -> None:
    study = tmp_path / "study"
    export(tmp_path, [markers(1)])
    (study / "participants.tsv").write_text("participant_id\tage\nsub-01\t34")
    (study / "README.md").unlink()
    (study / "README").write_text("mine")
    (study / "dataset_description.json").write_text("{}")
    scans = study / "sub-01/sub-01_scans.tsv"
    first = scans.read_text()
    export(tmp_path, [markers(1)])
    export(tmp_path, [markers(1)], BidsNames("walking", 7), subject="02")
    assert runs_of(study / "sub-01") == {("labMarkers", "1"), ("labMarkers", "2")}
    assert runs_of(study / "sub-02") == {("labMarkers", "7")}
    assert (study / "participants.tsv").read_text() == "participant_id\tage\nsub-01\t34\nsub-02\tn/a\n"
    assert scans.read_text() == first + first.splitlines()[1].replace("run-1", "run-2") + "\n"
    assert (study / "dataset_description.json").read_text() == "{}"
    assert not (study / "README.md").exists()


def content(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_an_export_that_fails_changes_nothing(tmp_path: Path) -> None:
    study = tmp_path / "study"
    export(tmp_path, [markers(1)])
    before = content(study)
    with pytest.raises(TakeError, match=r"_run-1_motion\.tsv exists already"):
        export(tmp_path, [markers(1)], replace(NAMES, run=1))
    assert content(study) == before
    (study / "sub-01/sub-01_scans.tsv").write_text("filename\tduration\n")
    before = content(study)
    with raises(TakeError, "sub-01_scans.tsv", "'acq_time'"):
        export(tmp_path, [markers(1)])
    assert content(study) == before
    (study / "participants.tsv").write_bytes(b"\xff")
    with raises(TakeError, "participants.tsv", "UTF-8"):
        export(tmp_path, [markers(1)], subject="02")
    assert not (study / "sub-02").exists()


def test_a_folder_of_other_files_is_not_made_a_data_set(tmp_path: Path) -> None:
    (tmp_path / "study").mkdir()
    (tmp_path / "study/thesis.txt").touch()
    with raises(SelectionError, "dataset_description.json"):
        export(tmp_path, [markers(1)])


def test_two_exports_to_one_data_set_cannot_lose_rows(tmp_path: Path) -> None:
    """Both would read participants.tsv, and the second one would replace it without the row of the first."""
    export(tmp_path, [markers(1)])
    with NewFiles() as other:
        other.lock_folder(tmp_path / "study")
        with pytest.raises(TakeError, match=r"another program .*study"):
            export(tmp_path, [markers(1)])
        (tmp_path / "study/dataset_description.json").unlink()  # as while the other one creates the data set
        with pytest.raises(TakeError, match=r"another program .*study"):
            export(tmp_path, [markers(1)])


def test_tables_of_spreadsheets_get_further_rows(tmp_path: Path) -> None:
    """They can begin with a byte order mark, and their lines can end in CR LF."""
    export(tmp_path, [markers(1)])
    table_path = tmp_path / "study/participants.tsv"
    table_path.write_bytes("\ufeffparticipant_id\tage\r\nsub-01\t34\r\n".encode())
    export(tmp_path, [markers(1)], subject="02")
    assert table_path.read_bytes() == b"participant_id\tage\nsub-01\t34\nsub-02\tn/a\n"


def test_a_take_without_samples_is_an_error(tmp_path: Path) -> None:
    with raises(TakeError, "markers, tools, analog channels or forces", "--bids"):
        export(tmp_path, [frame(ComponentType.EVENT, [(1, 2, -1, -1, -1)])])


@pytest.mark.parametrize("count", [250, 251])
def test_more_columns_than_the_validator_reads_are_reported(tmp_path: Path, count: int) -> None:
    job = export(tmp_path, [markers(count)])
    amounts = [note.amount for note in job.notes if "--max-rows" in note.what]
    assert amounts == ([str(4 * count)] if count > 250 else [])
