"""Exports of random takes to each format with a grid: each row has the value of its frame at its time.

Every value says which frame it is of. Whatever a server sends and the network loses, a frame is in one row of
one file, at most a period from when it was captured, or the table of changes counts it.
"""

import csv
import json
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import AnalogChannel, Marker, Parameters, Parameters3D, ParametersAnalog
from gateway.takes.export.job import BidsNames, ExportJob, export_take
from gateway.takes.files.component_rows import Array
from tests.support.examples import examples
from tests.support.takes import START_UTIME, Message, description, frame, parameters, write_take
from tests.unit.takes.export.exported import notes_of, read_ezc3d
from tests.unit.takes.export.test_bids import read_motion
from tests.unit.takes.export.test_every_format import since_begin_s
from tests.unit.takes.export.test_opensim import read_storage
from tests.unit.takes.export.test_trc import read_trc

PERIOD_US: Final = 10_000
FIRST_VALUE: Final = 100
PARAMETERS: Final = parameters(
    Parameters(
        markers=Parameters3D(100.0, "m", (Marker("1", "head"),)),
        analog=ParametersAnalog((AnalogChannel("1", "emg", frequency_hz=100.0),)),
    )
)
COMPONENTS: Final = {ComponentType.MARKERS: "3d", ComponentType.ANALOG: "analog"}
Rows = tuple[Array, Array]
"""The times of rows in s from the beginning of the take, and their values."""


class RandomTake(NamedTuple):
    """The messages of a take, and when the frame with each value was captured, in s from its beginning."""

    messages: list[Message]
    captured_s: dict[int, float]
    sent: dict[str, list[int]]
    """The values of the frames that arrived, by component; those that were sent twice occur twice."""

    def __repr__(self) -> str:
        return f"<{len(self.messages)} messages>"


@st.composite
def takes(draw: st.DrawFn) -> RandomTake:
    """Return a take of one or two measurements, in which anything can happen to frames on their way."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    jitter_us = draw(st.sampled_from([0, 1000, 3000]))
    late_us = draw(st.sampled_from([0, 6000]))
    lost = draw(st.sampled_from([0.0, 0.02, 0.2]))
    repeats = draw(st.booleans())
    num_markers = draw(st.sampled_from([1, 4]))
    messages, captured_s = [description(), PARAMETERS], {}
    sent: dict[str, list[int]] = {key: [] for key in COMPONENTS.values()}
    begin_us, value, sequence = 20_000, FIRST_VALUE, dict.fromkeys(COMPONENTS, 0)
    for measurement in range(draw(st.integers(1, 2))):
        count = draw(st.integers(100, 300))
        gap = range(draw(st.integers(20, count - 30)), 0)
        if draw(st.booleans()):
            gap = range(gap.start, gap.start + draw(st.integers(1, 25)))
        for number in range(count):
            time_us = begin_us + number * PERIOD_US
            stamp_us = 5_000_000 + number * PERIOD_US + int(random.integers(-jitter_us, jitter_us + 1))
            stamp_us += late_us * (number % 50 == 25)
            captured_s[value] = (time_us - 2000) / 1e6
            for component, key in COMPONENTS.items():
                is_lost = number in gap or random.random() < lost
                for _ in range(1 + repeats * int(random.integers(2))):
                    if not is_lost:
                        marker = (value, 0.0, 0.0, 0.0)
                        shown = [marker] * int(random.integers(1, num_markers + 1))
                        items = shown if component is ComponentType.MARKERS else [value]
                        sent[key].append(value)
                        messages.append(
                            frame(
                                component, items, sequence[component], frame_number=number + 1,
                                utime=START_UTIME + time_us, timestamp_us=stamp_us, session=measurement + 1,
                            )
                        )  # fmt: skip
                    sequence[component] += 1
            value += 1
        begin_us += (count + 50) * PERIOD_US
    return RandomTake(messages, captured_s, sent)


def c3d_rows(folder: Path) -> Iterator[tuple[str, Rows]]:
    for path in folder.glob("*.c3d"):
        found = read_ezc3d(path)
        start_s = float(found["parameters"]["TRIAL"]["TIME_OFFSET"]["value"][0])
        for key, values, part in (
            ("3d", found["data"]["points"][0, 0], "points"),
            ("analog", found["data"]["analogs"][0, 0], "analogs"),
        ):
            yield key, (start_s + np.arange(len(values)) / found["header"][part]["frame_rate"], values)


def trc_rows(folder: Path) -> Iterator[tuple[str, Rows]]:
    for path in folder.rglob("*.trc"):
        found = read_trc(path)
        yield "3d", (np.array(found.times_s), found.positions[:, 0, 0])


def sto_rows(folder: Path) -> Iterator[tuple[str, Rows]]:
    for path in folder.rglob("*.sto"):
        found = read_storage(path)
        yield "analog", (found.times_s, found.values[:, 0])


def opensim_rows(folder: Path) -> Iterator[tuple[str, Rows]]:
    yield from trc_rows(folder)
    yield from sto_rows(folder)


def bids_rows(folder: Path) -> Iterator[tuple[str, Rows]]:
    [scans] = folder.rglob("*_scans.tsv")
    for row in csv.DictReader(scans.read_text().splitlines(), delimiter="\t"):
        path = scans.parent / row["filename"]
        rate_hz = json.loads(path.with_suffix(".json").read_text())["SamplingFrequency"]
        values = read_motion(path)[:, 0]
        times_s = since_begin_s(row["acq_time"]) + np.arange(len(values)) / rate_hz
        yield "3d" if "Markers" in path.name else "analog", (times_s, values)


FORMATS: Final[dict[str, Callable[[Path], Iterator[tuple[str, Rows]]]]] = {
    ".c3d": c3d_rows,
    ".trc": trc_rows,
    ".sto": sto_rows,
    "opensim": opensim_rows,
    "bids": bids_rows,
}


@pytest.mark.parametrize("form", FORMATS)
@settings(max_examples=examples(8))
@given(take=takes())
def test_each_row_has_the_value_of_its_frame_at_its_time(form: str, take: RandomTake) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        chosen = "" if form.startswith(".") else form
        path = write_take(folder / "take.lcmlog", take.messages)
        job = ExportJob(path, folder / f"out{'' if chosen else form}", chosen, bids=BidsNames("walking"))
        job.details = {"subject": "01"}
        export_take(job)
        found: dict[str, list[Rows]] = {}
        for key, rows in FORMATS[form](folder):
            found.setdefault(key, []).append(rows)
    notes = notes_of(job)
    for key, files in found.items():
        times_s, values = (np.concatenate(columns) for columns in zip(*files, strict=True))
        is_frame = ~np.isnan(values)
        written = [round(value) for value in values[is_frame].tolist()]
        assert len(set(written)) == len(written)
        assert set(written) <= set(take.sent[key])
        captured_s = np.array([take.captured_s[value] for value in written])
        assert abs(times_s[is_frame] - captured_s).max() < PERIOD_US / 1e6
        counted = [re.search(rf"rows of {key} of lab .* (\d+) of", note) for note in notes]
        missing = sum(int(each[1]) for each in counted if each)
        assert len(take.sent[key]) - len(written) == missing
    assert not any("last row" in note for note in notes)
