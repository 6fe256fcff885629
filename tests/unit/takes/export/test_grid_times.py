"""Each frame has its time in every format with a grid, whatever the server's time stamps do.

The files are read by other programs' readers, and each row is compared with the time of capture of its frame.
"""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from gateway.rtc3d.components import ComponentType
from gateway.simulator.synthetic import SyntheticScene
from gateway.takes.export.job import BidsNames, ExportJob, export_take
from tests.support.errors import each_names, names, one_names
from tests.support.takes import START_UTIME, Message, description, frame, markers, parameters, write_take
from tests.unit.takes.export.exported import Values, labelled, notes_of, read_ezc3d, read_independently
from tests.unit.takes.export.test_bids import read_motion
from tests.unit.takes.export.test_every_format import since_begin_s
from tests.unit.takes.export.test_opensim import read_storage
from tests.unit.takes.export.test_trc import read_trc

NUM_FRAMES: Final = 1600
PERIOD_US: Final = 10_000
SCENE: Final = SyntheticScene(markers=2, tools=1, analog=2, plates=1, rate_hz=100, analog_rate_hz=100, seed=5)


def late_frames() -> Values:
    """Return the times of frames of which one in 50 is late by 6 ms."""
    times = np.arange(NUM_FRAMES) * PERIOD_US
    times[25::50] += 6000
    return times


def with_jitter() -> Values:
    return np.arange(NUM_FRAMES) * PERIOD_US + np.random.default_rng(4).integers(-3000, 3000, NUM_FRAMES)


def another_rate_for_a_while() -> Values:
    rates = np.repeat([100.0, 71.0, 100.0], [600, 400, 600])
    return np.cumsum(1e6 / rates).astype(np.int64)


TIMES: Final[dict[str, tuple[Callable[[], Values], int]]] = {
    "exact": (lambda: np.arange(NUM_FRAMES) * PERIOD_US, 1),
    "each frame twice": (lambda: np.arange(NUM_FRAMES) * PERIOD_US, 2),
    "late frames": (late_frames, 1),
    "jitter": (with_jitter, 1),
    "another rate": (another_rate_for_a_while, 1),
}


def messages_of(times_us: Values, repeats: int) -> list[Message]:
    """Return a take of frames that were captured at these times after its beginning."""
    items = {
        component: SCENE.items(component, np.arange(len(times_us)))
        for component in (
            ComponentType.MARKERS,
            ComponentType.TOOLS,
            ComponentType.ANALOG,
            ComponentType.FORCE,
        )
    }
    for values in items.values():  # in view all the time
        plain = values.view(np.float32)
        plain[np.isnan(plain)] = 1.0
    messages = [description(), parameters(SCENE.parameters)]
    for number, time_us in enumerate(times_us.tolist()):
        for again in range(repeats):
            messages += [
                frame(
                    component,
                    values[number].tolist(),
                    number * repeats + again,
                    utime=START_UTIME + 10_000 + time_us + 100 * again,
                    timestamp_us=5_000_000 + time_us,
                    frame_number=number,
                )
                for component, values in items.items()
            ]
    return messages


def present(times_s: Any, values: Values) -> Values:
    """Return the times of the rows that have a value."""
    return np.asarray(times_s)[~np.isnan(values)]


def c3d_times(folder: Path) -> list[Values]:
    found, other = read_ezc3d(folder / "take.c3d"), read_independently(folder / "take.c3d")
    start_s = float(found["parameters"]["TRIAL"]["TIME_OFFSET"]["value"][0])
    x = found["data"]["points"][0, 0]
    analog = found["data"]["analogs"][0, 0]
    times = [start_s + np.arange(len(x)) / found["header"]["points"]["frame_rate"]]
    times.append(start_s + np.arange(len(analog)) / found["header"]["analogs"]["frame_rate"])
    visible = other.is_visible[:, 0]
    independent = start_s + np.flatnonzero(visible) / other.point_rate_hz
    return [present(times[0], x), present(times[1], analog), independent]


def bids_times(folder: Path) -> list[Values]:
    [session] = (folder / "take").glob("sub-*")
    [scans] = session.rglob("*_scans.tsv")
    found = []
    for row in csv.DictReader(scans.read_text().splitlines(), delimiter="\t"):
        path = scans.parent / row["filename"]
        about = json.loads(path.with_suffix(".json").read_text())
        values = read_motion(path)
        times_s = since_begin_s(row["acq_time"]) + np.arange(len(values)) / about["SamplingFrequency"]
        found.append(present(times_s, values[:, 0]))
    assert len(found) == 4
    return found


def trc_times(path: Path) -> Values:
    found = read_trc(path)
    return present(found.times_s, found.positions[:, 0, 0])


FORMATS: Final[dict[str, Callable[[Path], list[Values]]]] = {
    ".c3d": c3d_times,
    ".trc": lambda folder: [trc_times(folder / "take.trc")],
    ".mot": lambda folder: [read_storage(folder / "take.mot").times_s],
    ".sto": lambda folder: [read_storage(folder / "take.sto").times_s],
    "opensim": lambda folder: [
        trc_times(folder / "take/take.trc"),
        read_storage(folder / "take/take.mot").times_s,
        read_storage(folder / "take/take.sto").times_s,
    ],
    "bids": bids_times,
}


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("case", TIMES)
def test_each_row_has_the_time_of_its_frame(tmp_path: Path, case: str, form: str) -> None:
    times_us, repeats = TIMES[case][0](), TIMES[case][1]
    take = write_take(tmp_path / "take.lcmlog", messages_of(times_us, repeats))
    chosen = "" if form.startswith(".") else form
    job = ExportJob(take, tmp_path / f"take{'' if chosen else form}", chosen, bids=BidsNames("walking"))
    job.details = {"subject": "01"}
    export_take(job)
    captured_s = (times_us + 8000) / 1e6
    for found_s in FORMATS[form](tmp_path):
        assert len(found_s) == NUM_FRAMES
        errors_s = found_s - captured_s
        assert abs(errors_s).max() < 0.010
        assert abs(errors_s[-1]) < 0.010
    notes = notes_of(job)
    assert not any("frames missing" in note for note in notes)
    assert not one_names(notes, "last row")
    assert any("left out" in note and str(NUM_FRAMES) in note for note in notes) == (repeats == 2)
    assert each_names(
        [note for note in notes if names(note, "rows", "lab")],
        *(
            [key, f"{NUM_FRAMES} of {2 * NUM_FRAMES}"]
            for key in (job.chosen_format.components if repeats == 2 else ())
            if key != "event"
        ),
    )
    assert one_names(notes, "grid") == (case == "late frames") or (case == "another rate")


@pytest.mark.parametrize(("period_us", "word"), [(10_040, "earlier"), (9_960, "later")])
def test_the_time_of_the_last_row_is_reported_if_the_announced_rate_is_a_little_wrong(
    tmp_path: Path, period_us: int, word: str
) -> None:
    """The file has the announced rate, so its times drift from those of the frames."""
    take = write_take(tmp_path / "take.lcmlog", messages_of(np.arange(1001) * period_us, 1))
    job = ExportJob(take, tmp_path / "take.trc")
    export_take(job)
    [note] = [note for note in notes_of(job) if names(note, "last row")]
    assert names(note, word, "38.0 ms")


@pytest.mark.parametrize("form", [".c3d", ".trc", "bids"])
def test_a_number_of_markers_that_varies_is_one_measurement(tmp_path: Path, form: str) -> None:
    """Servers send markers without a label, so each frame may have another number of them."""
    counts = np.random.default_rng(2).integers(2, 7, 400).tolist()
    messages = [labelled("head", "hip"), *(markers(count, number) for number, count in enumerate(counts))]
    take = write_take(tmp_path / "take.lcmlog", messages)
    chosen = "" if form.startswith(".") else form
    job = ExportJob(take, tmp_path / f"take{'' if chosen else form}", chosen, bids=BidsNames("walking"))
    job.details = {"subject": "01"}
    export_take(job)
    if form == ".c3d":
        x = read_ezc3d(tmp_path / "take.c3d")["data"]["points"][0].T
    elif form == ".trc":
        x = read_trc(tmp_path / "take.trc").positions[..., 0]
    else:
        [motion] = (tmp_path / "take").rglob("*_motion.tsv")
        x = read_motion(motion)[:, ::4] * 1000
    assert x.shape == (400, 6)
    assert (~np.isnan(x)).sum(axis=1).tolist() == counts
    places = np.where(np.isnan(x), 0, x) - np.where(np.isnan(x), 0, np.arange(6))
    assert abs(places).max() < 1e-6
