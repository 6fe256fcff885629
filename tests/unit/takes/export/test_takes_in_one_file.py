"""``cat b a > c`` is exported like takes in the right order, to each format.

Nobody can see in the new file that its rows are in a wrong order, or there twice.
"""

from pathlib import Path
from typing import Any, Final

import pytest

from gateway.simulator.synthetic import SyntheticScene
from gateway.takes import open_take
from gateway.takes.export.job import ExportJob, TakePart, export_take
from tests.support.errors import one_names
from tests.support.takes import Message, description, parameters, scene_messages, write_take
from tests.unit.takes.export.exported import notes_of
from tests.unit.takes.export.test_every_format import NAMES, job_for

NUM_FRAMES: Final = 30
SCENE: Final = SyntheticScene(markers=2, tools=1, analog=2, plates=1, rate_hz=100, analog_rate_hz=200)


def take_of(folder: Path, order: str) -> Path:
    """Return a take in whose file others follow each other: "b" is 20 s later than "a"."""
    folder.mkdir(parents=True)
    content = b""
    for letter in order:
        start_us = 20_000_000 * (letter == "b")
        messages: list[Message] = [description(), parameters(SCENE.parameters)]
        messages += scene_messages(SCENE, NUM_FRAMES, start_us=start_us, server_start_us=5_000_000 + start_us)
        if letter == "b":  # they were made at their beginning
            messages[:2] = [later(each, start_us) for each in messages[:2]]
        content += write_take(folder / "part.lcmlog", messages).read_bytes()
    path = folder / "take.lcmlog"
    path.write_bytes(content)
    return path


def later(message: Message, time_us: int) -> Message:
    """Return a message whose time is later."""
    channel, data = message
    utime = int.from_bytes(data[8:16], "big") + time_us
    return channel, data[:8] + utime.to_bytes(8, "big") + data[16:]


def export_of(folder: Path, form: str, order: str, **options: Any) -> tuple[dict[str, bytes], ExportJob]:
    """Return the files of an export of takes in one file, in this order."""
    take = take_of(folder / order, order)
    job = job_for(form, take, folder / f"new-{order}", **options)
    job.details = {"subject": "01"}
    files = {str(path.relative_to(job.out.parent)): path.read_bytes() for path in export_take(job)}
    return files, job


@pytest.mark.parametrize("form", NAMES)
@pytest.mark.parametrize(("order", "same"), [("ba", "ab"), ("aa", "a"), ("bab", "ab")])
def test_the_order_of_takes_in_a_file_and_their_number_change_nothing(
    tmp_path: Path, form: str, order: str, same: str
) -> None:
    """The files are those of the right order to the byte, and a note says how many takes were found."""
    if form in {".parquet", ".mcap", "ros2"}:
        pytest.importorskip("foxglove" if form != ".parquet" else "pyarrow")
    found, job = export_of(tmp_path, form, order)
    expected, _ = export_of(tmp_path, form, same)
    assert found == expected
    assert one_names(notes_of(job), "several takes", len(order))


@pytest.mark.parametrize("form", [".c3d", ".csv", ".mcap", "ros2"])
@pytest.mark.parametrize(("from_s", "to_s"), [(None, 0.1), (0.1, None), (0.1, 20.1), (20.1, None)])
def test_the_range_counts_from_the_first_moment_of_all_takes(
    tmp_path: Path, form: str, from_s: float | None, to_s: float | None
) -> None:
    """Also if the file begins with another moment."""
    part = TakePart(None, from_s, to_s)
    assert export_of(tmp_path, form, "ba", part=part)[0] == export_of(tmp_path, form, "ab", part=part)[0]


def test_csv_has_the_rows_of_open_take(tmp_path: Path) -> None:
    """In its order, as often."""
    files, job = export_of(tmp_path, ".csv", "bab")
    source = open_take(job.take).sources["lab"]
    assert source.series.keys() == {"3d", "6d", "analog", "force"}
    for key, series in source.series.items():
        lines = files[f"take-{key}.csv"].splitlines()
        column = lines[0].split(b",").index(b"sequence")
        assert [int(line.split(b",")[column]) for line in lines[1:]] == series.sequence.tolist()
