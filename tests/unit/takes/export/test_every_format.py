"""What holds for each format, also for those that will be added: sources, progress, what is reported."""

import csv
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import UTC, datetime
from functools import partial
from itertools import count, groupby, pairwise
from pathlib import Path
from typing import Any, Final

import pandas as pd
import pytest
import rtc3d
from mcap.reader import make_reader

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    Parameters,
    Parameters6D,
    ParametersAnalog,
    ParametersEvents,
    Tool,
)
from gateway.simulator.synthetic import SyntheticScene
from gateway.takes.export.job import (
    BidsNames,
    ExportJob,
    TakePart,
    export_take,
)
from gateway.takes.export.registry import CHOSEN_FORMATS, FORMATS, Format
from tests.support.takes import (
    START_UTIME,
    Message,
    description,
    details,
    frame,
    markers,
    parameters,
    scene_messages,
    write_take,
)
from tests.unit.takes.export import exported
from tests.unit.takes.export.exported import C3d, notes_of
from tests.unit.takes.export.read_mcap import read_mcap
from tests.unit.takes.export.test_opensim import read_storage
from tests.unit.takes.export.test_rosbag import Bag
from tests.unit.takes.export.test_trc import read_trc
from tests.unit.takes.files.test_take import recorded

NAMES: Final = [*FORMATS, *CHOSEN_FORMATS]


def scene_of(rate_hz: float) -> SyntheticScene:
    return SyntheticScene(markers=2, tools=1, analog=2, plates=1, rate_hz=rate_hz, analog_rate_hz=2 * rate_hz)


LEFT, RIGHT = scene_of(100), scene_of(60)
RIGHT_BEGINS_S: Final = 0.2


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a take of two sources with rates and clocks of their own, of which one began 0.2 s later."""
    messages: list[Message] = []
    for name, scene, start_s in (("left", LEFT, 0.0), ("right", RIGHT, RIGHT_BEGINS_S)):
        messages += [description(name), details("Grace", "day1", "left knee", name)]
        messages.append(parameters(scene.parameters, source=name))
        start_us, server_us = round(start_s * 1e6), 10_000_000 * len(name)
        messages += scene_messages(scene, 60, source=name, start_us=start_us, server_start_us=server_us)
    # In the order of arrival; descriptions, which have the time of the beginning, stay the first ones.
    messages.sort(key=lambda message: message[1][8:16])
    return write_take(tmp_path_factory.mktemp("take") / "take.lcmlog", messages)


def job_for(name: str, take: Path, folder: Path, **options: Any) -> ExportJob:
    """Return the job that exports to a format: an extension, or the option that chooses it."""
    folder.mkdir(exist_ok=True)
    suffix = name if name in FORMATS else ".mcap" if name == "ros2" else ""
    chosen = name if name in CHOSEN_FORMATS else ""
    return ExportJob(take, folder / f"take{suffix}", chosen, bids=BidsNames("walking"), **options)


def since_begin_s(utc: str) -> float:
    return (datetime.fromisoformat(utc) - datetime.fromtimestamp(START_UTIME / 1e6, UTC)).total_seconds()


def utime_s(utime: float) -> float:
    return utime / 1e6 - START_UTIME / 1e6


def trc_start_s(folder: Path, source: str) -> float:
    path = folder / f"take-{source}.trc"
    time_0 = path.read_text().splitlines()[0].partition("time_0=")[2]
    return since_begin_s(time_0) + read_trc(path).times_s[0]


def storage_start_s(end: str, folder: Path, source: str) -> float:
    found = read_storage(folder / f"take-{source}{end}")
    return since_begin_s(found.header["time_0"]) + float(found.times_s[0])


def opensim_start_s(folder: Path, source: str) -> float:
    starts_s = [storage_start_s(end, folder / "take", source) for end in (".mot", ".sto")]
    assert starts_s == pytest.approx([trc_start_s(folder / "take", source)] * 2, abs=1e-3)
    return starts_s[0]


def csv_start_s(folder: Path, source: str) -> float:
    with (folder / f"take-{source}-3d.csv").open() as file:
        return utime_s(float(next(csv.DictReader(file))["capture_utime"]))


def bids_start_s(folder: Path, source: str) -> float:
    with (folder / "take/sub-Grace/ses-day1/sub-Grace_ses-day1_scans.tsv").open() as file:
        times = {row["filename"]: row["acq_time"] for row in csv.DictReader(file, delimiter="\t")}
    name = f"motion/sub-Grace_ses-day1_task-walking_tracksys-{source}Markers_run-1_motion.tsv"
    return since_begin_s(times[name])


FIRST_FRAMES: Final[dict[str, Callable[[Path, str], float]]] = {
    ".c3d": lambda folder, source: since_begin_s(C3d(folder / f"take-{source}.c3d")("TRIAL", "DATE_TIME")[0]),
    ".trc": trc_start_s,
    ".mot": partial(storage_start_s, ".mot"),
    ".sto": partial(storage_start_s, ".sto"),
    ".csv": csv_start_s,
    ".parquet": lambda folder, source: utime_s(
        pd.read_parquet(folder / f"take-{source}-3d.parquet")["capture_utime"][0]
    ),
    ".mcap": lambda folder, source: utime_s(
        read_mcap(folder / "take.mcap").topics[f"/{source}/markers"][0].time_ns / 1000
    ),
    "opensim": opensim_start_s,
    "bids": bids_start_s,
    "ros2": lambda folder, source: utime_s(
        Bag(folder / "take.mcap").messages[f"/mocap/{source}/markers"][0][0] / 1000
    ),
}
"""When the first frame of a source was captured, in s from the beginning of the take, as the files say."""


@pytest.mark.parametrize("name", NAMES)
def test_sources_have_their_own_rates_and_the_times_of_this_computer(
    take: Path, tmp_path: Path, name: str
) -> None:
    """Servers have clocks of their own, which start at any time: their files would not fit together."""
    export_take(job_for(name, take, tmp_path))
    for source, start_s in (("left", 0.0), ("right", RIGHT_BEGINS_S)):
        assert FIRST_FRAMES[name](tmp_path, source) == pytest.approx(start_s, abs=2e-3)


@pytest.mark.parametrize("name", NAMES)
def test_one_source_alone_is_exported_without_its_name(take: Path, tmp_path: Path, name: str) -> None:
    paths = export_take(job_for(name, take, tmp_path, part=TakePart("right")))
    assert not any("left" in str(path.relative_to(tmp_path)) for path in paths)
    if name != "bids":  # its tracking systems always have the name of the source
        assert not any("right" in path.name for path in paths)


def source_messages(name: str, channels: str, *, num_measurements: int = 1) -> Iterator[Message]:
    """Yield the messages of a source of any name, whose channels begin with MOCAP_ and ``channels``."""
    about = rtc3d.take_t()
    about.utime, about.source, about.channels = START_UTIME, name, f"MOCAP_{channels}"
    yield f"MOCAP_{channels}_TAKE", about.encode()
    yield parameters(LEFT.parameters, source=channels)
    for session in range(num_measurements):
        yield from scene_messages(
            LEFT, 20, source=channels, session=session, start_us=session * 1_000_000, sequence=session * 1000
        )


@pytest.mark.parametrize("name", NAMES)
def test_names_of_sources_cannot_break_files_or_replace_those_of_others(tmp_path: Path, name: str) -> None:
    messages = [
        *source_messages("a/b", "A", num_measurements=2),
        *source_messages("a_b", "B"),
        *source_messages("a_b-2", "C"),
        *source_messages("tab\tline\n", "D"),
    ]
    take = write_take(tmp_path / "take.lcmlog", messages)
    paths = export_take(job_for(name, take, tmp_path / "out", details={"subject": "01"}))
    assert all(path.name.isprintable() for path in paths)
    match name:
        case ".mot" | ".sto":
            names = {"take-a_b-1", "take-a_b-2", "take-a_b", "take-a_b-2_2", "take-tab_line_"}
            assert {path.stem for path in paths} == names
            assert all(len(read_storage(path).times_s) == 40 for path in paths)
        case "bids":
            tables = [path.read_text().splitlines() for path in paths if path.name.endswith("_channels.tsv")]
            assert {len({line.count("\t") for line in lines}) for lines in tables} == {1}


@pytest.mark.parametrize("name", NAMES)
def test_who_and_what_a_take_is_about_is_kept_or_reported_and_can_be_replaced(
    take: Path, tmp_path: Path, name: str
) -> None:
    about = {"subject": "Ada", "session": "", "note": "right knee"}
    job = job_for(name, take, tmp_path, details=about)
    paths = export_take(job)
    written = b"".join(str(path.relative_to(tmp_path)).encode() + path.read_bytes() for path in paths)
    is_kept = job.chosen_format.keeps_details
    for text, is_new in ((b"Ada", True), (b"right knee", True), (b"Grace", False), (b"day1", False)):
        assert (text in written) == (is_new and is_kept), text
    assert ("subject, note" in "".join(notes_of(job, usual=True))) != is_kept


def some(scene: SyntheticScene) -> list[Message]:
    return [parameters(scene.parameters), *scene_messages(scene, 20)]


ANALOG_ONLY = SyntheticScene(markers=0, tools=0, analog=2, plates=0, rate_hz=100, analog_rate_hz=200)
MARKERS_ONLY = SyntheticScene(markers=2, tools=0, analog=0, plates=0, rate_hz=100, analog_rate_hz=200)


@pytest.mark.parametrize(
    ("name", "messages", "expected"),
    [
        (".trc", some(LEFT), "tools (6D), analog channels, forces, reliabilities of markers"),
        (".trc", some(MARKERS_ONLY), "reliabilities of markers"),
        ("opensim", some(ANALOG_ONLY), ""),
        (".csv", some(LEFT), "parameters except labels and units"),
        (".csv", [markers(2)], ""),
        (".mcap", some(LEFT), "errors of tools, frame numbers, server's time stamps"),
        (".mcap", some(MARKERS_ONLY), "frame numbers, server's time stamps"),
        (
            "ros2",
            [*some(MARKERS_ONLY), frame(ComponentType.EVENT, [(1, 2, -1, -1, -1)])],
            "frame numbers, server's time stamps",
        ),
        ("bids", [details("Ada"), *some(LEFT)], ""),
    ],
)
def test_what_a_format_has_no_place_for_is_reported_if_the_take_has_it(
    tmp_path: Path, name: str, messages: list[Message], expected: str
) -> None:
    job = job_for(name, write_take(tmp_path / "plain.lcmlog", messages), tmp_path / "new")
    export_take(job)
    found = [note.what for note in job.notes if note.what.startswith("left out of ")]
    assert found == ([f"left out of lab: {expected}"] if expected else [])


Call = tuple[str, int, int]


def stages(calls: Iterable[Call]) -> list[tuple[str, list[Call]]]:
    return [(what, list(found)) for what, found in groupby(calls, lambda call: call[0])]


@pytest.fixture(scope="module")
def long_take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a take that is written in several blocks, with messages after 20 s that are not read."""
    messages = [parameters(LEFT.parameters), details("Grace"), *scene_messages(LEFT, 600)]
    messages += [parameters(LEFT.parameters, 2, utime=START_UTIME + 20_000_000), markers(2, 2000, version=2)]
    return write_take(tmp_path_factory.mktemp("long") / "take.lcmlog", messages)


@pytest.mark.parametrize("name", NAMES)
def test_progress_grows_up_to_the_end_of_each_step(long_take: Path, tmp_path: Path, name: str) -> None:
    calls: list[Call] = []
    job = job_for(
        name, long_take, tmp_path, progress=lambda *call: calls.append(call), part=TakePart(to_s=5.5)
    )
    export_take(job)
    steps = stages(calls)
    names = [what for what, _ in steps]
    assert len(set(names)) == len(names)
    assert names[0] == "reading take.lcmlog"
    assert any(what.startswith("writing ") for what in names)
    assert steps.pop() == (f"saving {job.out.name}", [(f"saving {job.out.name}", 0, 0)])
    for what, found in steps:
        done = [each for _, each, _ in found]
        assert done == sorted(done), what
        assert {total for _, _, total in found} == {done[-1]}, what


@pytest.mark.parametrize("name", [".csv", ".mcap"])
def test_what_is_written_while_it_is_read_is_read_to_the_end_of_the_range(
    long_take: Path, tmp_path: Path, name: str
) -> None:
    """The first seconds of an hour take seconds, not minutes."""
    calls: list[Call] = []
    export_take(
        job_for(name, long_take, tmp_path, progress=lambda *call: calls.append(call), part=TakePart(to_s=5.5))
    )
    [done] = ([each for _, each, _ in found] for what, found in stages(calls) if what.startswith("writing"))
    assert done[-2] < done[-1]


class Interruption:
    """The progress of an export in which the user presses Ctrl-C at a certain call."""

    def __init__(self, number: int) -> None:
        self._remaining = number

    def __call__(self, _what: str, _done: int, _total: int) -> None:
        if not self._remaining:
            raise KeyboardInterrupt
        self._remaining -= 1


@pytest.mark.parametrize("name", NAMES)
def test_an_interruption_at_any_time_leaves_nothing(take: Path, tmp_path: Path, name: str) -> None:
    for number in count():
        job = job_for(name, take, tmp_path, progress=Interruption(number))
        try:
            export_take(job)
        except KeyboardInterrupt:
            assert list(tmp_path.rglob("*")) == []
        else:
            break
    assert number >= 3  # reading, writing, saving
    assert list(tmp_path.rglob("*")) != []


@pytest.mark.parametrize("name", [".mcap", "ros2"])
def test_messages_are_in_the_order_of_time(name: str, tmp_path: Path) -> None:
    """Players read from the beginning, and need the index only to seek: chunks must not overlap.

    New parameters end a part of the take that is read at once; some messages are overtaken by them.
    """
    messages = exported.scene(300)
    half = len(messages) // 2
    overtaken, early = messages[half - 20 : half], messages[half : half + 20]
    changed = exported.labelled("head", version=2)
    messages[half - 20 : half + 20] = [*early, changed, *overtaken]
    take = write_take(tmp_path / "take.lcmlog", messages)
    export_take(job_for(name, take, tmp_path / "out"))
    with (tmp_path / "out/take.mcap").open("rb") as file:
        found = make_reader(file)
        times = [message.log_time for _, _, message in found.iter_messages(log_time_order=False)]
        summary = found.get_summary()
    assert len(times) > 3000
    assert times == sorted(times)
    assert summary is not None
    chunks = summary.chunk_indexes
    assert all(a.message_end_time <= b.message_start_time for a, b in pairwise(chunks))


def items_called(component: ComponentType, labels: Sequence[str]) -> list[Message]:
    """Return parameters with these labels, and a frame with an item for each."""
    numbered = [*enumerate(labels)]
    match component:
        case ComponentType.MARKERS:
            return [exported.labelled(*labels), markers(len(labels))]
        case ComponentType.TOOLS:
            tools = Parameters6D(100.0, tuple(Tool(str(n), label) for n, label in numbered))
            poses = [(1, 0, 0, 0, 1, 2, 3, 0)] * len(labels)
            return [parameters(Parameters(tools=tools)), frame(component, poses)]
    channels = tuple(AnalogChannel(str(n), label, frequency_hz=100.0) for n, label in numbered)
    return [parameters(Parameters(analog=ParametersAnalog(channels))), frame(component, [1.0] * len(labels))]


@pytest.mark.parametrize("component", [ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.ANALOG])
@pytest.mark.parametrize("name", NAMES)
def test_every_label_that_is_not_as_the_server_gave_it_is_reported(
    name: str, component: ComponentType, tmp_path: Path
) -> None:
    """Repeated ones get a number, and one is too long, also to be named in full."""
    if component.key not in format_of(name).components or name == ".mot":
        return
    labels = ["a", "b", "a", "a", "x" * 300]
    take = write_take(tmp_path / "take.lcmlog", items_called(component, labels))
    job = job_for(name, take, tmp_path / "out")
    job.details = {"subject": "01"}
    export_take(job)
    [note] = [note for note in job.notes if note.what.startswith(f"labels of {component.item_noun} of lab")]
    assert note.amount == "3"
    for old, new in (("a", "a_2"), ("a", "a_3"), ("x" * 39 + "…", "x" * 39 + "…")):
        assert f"'{old}' is '{new}'" in note.what


@pytest.mark.parametrize("name", NAMES)
def test_labels_that_stay_are_not_reported(name: str, tmp_path: Path) -> None:
    """Nor those of items without a label, which are called by their position."""
    for component in (ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.ANALOG):
        folder = tmp_path / component.key
        folder.mkdir()
        if component.key in format_of(name).components and name != ".mot":
            take = write_take(folder / "take.lcmlog", items_called(component, ["a", "b"]))
            job = job_for(name, take, folder / "out")
            job.details = {"subject": "01"}
            export_take(job)
            assert not any(note.what.startswith("labels of ") for note in job.notes)


@pytest.mark.parametrize("name", [".c3d", "bids"])
def test_labels_of_events_that_are_not_as_the_server_gave_them_are_reported(
    name: str, tmp_path: Path
) -> None:
    """Each label once, however often the event occurs; C3D files also cut long ones."""
    labels = ["start", "left\tdown", "ü" * 100]
    events = tuple(EventDefinition(str(n), label) for n, label in enumerate(labels))
    messages = [parameters(Parameters(events=ParametersEvents(events)))]
    messages += [markers(1, number) for number in range(20)]
    messages += [frame(ComponentType.EVENT, [(n % 3, -1, -1, -1, -1)], n) for n in range(9)]
    job = job_for(name, write_take(tmp_path / "take.lcmlog", messages), tmp_path / "out")
    job.details = {"subject": "01"}
    export_take(job)
    [note] = [note for note in job.notes if note.what.startswith("labels of events of lab")]
    assert note.amount == ("2" if name == ".c3d" else "1")
    assert r"'left\tdown' is 'left_down'" in note.what
    assert "start" not in note.what


def test_ten_labels_are_named_and_all_are_counted(tmp_path: Path) -> None:
    take = write_take(tmp_path / "take.lcmlog", items_called(ComponentType.MARKERS, ["a"] * 27))
    job = job_for(".trc", take, tmp_path / "out")
    export_take(job)
    [note] = [note for note in job.notes if note.what.startswith("labels of ")]
    assert note.amount == "26"
    assert "'a' is 'a_11'" in note.what
    assert "a_12" not in note.what


def format_of(name: str) -> Format:
    return FORMATS[name] if name in FORMATS else CHOSEN_FORMATS[name]


@pytest.mark.parametrize("has_end", [True, False])
def test_a_take_that_was_cut_off_is_reported_first(has_end: bool, tmp_path: Path) -> None:
    take = recorded(tmp_path, "a", 0, has_end=has_end)
    job = job_for(".csv", take, tmp_path / "out")
    export_take(job)
    assert job.notes[0].what.startswith("INCOMPLETE") == (not has_end)


def test_messages_that_the_recorder_lost_are_reported_first(tmp_path: Path) -> None:
    job = job_for(".csv", recorded(tmp_path, "a", 0, num_lost=7), tmp_path / "out")
    export_take(job)
    assert job.notes[0].what.startswith("INCOMPLETE")
    assert job.notes[0].amount == "7"
