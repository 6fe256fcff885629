"""What ``take list`` and ``take info`` print."""

import io
import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from typer.testing import CliRunner

from gateway.errors import TakeError
from gateway.rtc3d.parameters import Marker, Parameters, Parameters3D
from gateway.takes.files.description import SourceDescription
from gateway.tools.cli.main import app
from gateway.tools.cli.take_report import ListedTake, write_list
from tests.support.errors import names
from tests.support.takes import START_UTIME, description, markers, parameters, write_take

TAKE = {"name": "walk-1", "bytes": 3_456_789, "begin_utime": 1_700_000_000_000_000, "seconds": 83.25}


def written(**content: Any) -> str:
    out = io.StringIO()
    write_list({"lab": content}, Console(file=out, width=120, force_terminal=True, color_system=None))
    return out.getvalue()


def test_a_row_has_what_matters() -> None:
    text = written(takes=[TAKE | {"is_running": True, "lost": 3}], num_takes=1, kept_s=59.7)
    for part in ("lab", "walk-1", "1 min 23.2 s", "3.5 MB", "running, 3 messages lost"):
        assert part in text
    assert any(names(line, "lab", "60 s", "take save") for line in text.splitlines())


def test_what_takes_are_about_is_a_column_if_somebody_said_it() -> None:
    about = {"subject": "S01", "session": "pre", "note": "left knee"}
    assert "subject S01, session pre: left knee" in written(takes=[TAKE, TAKE | about], num_takes=2)
    assert "about" not in written(takes=[TAKE], num_takes=1)


def test_without_a_terminal_there_is_one_line_for_each_take(capsys: pytest.CaptureFixture[str]) -> None:
    """It was a table of 80 columns, with names on two lines."""
    out = io.StringIO()
    take = TAKE | {"name": "x" * 70 + "\t\n", "is_running": True}
    write_list({"lab": {"takes": [take], "num_takes": 2}}, Console(file=out, width=80))
    begin = ListedTake(TAKE).begin_text
    assert out.getvalue() == f"lab\t{'x' * 70}\\t\\n\t{begin}\t1 min 23.2 s\t3.5 MB\trunning\n"
    assert capsys.readouterr().err == "lab: the newest 1 of 2 takes\n"


def test_no_takes_are_no_table_and_a_list_with_a_limit_says_so() -> None:
    assert written(takes=[], num_takes=0, kept_s=0.0) == "lab: no takes\n"
    assert names(written(takes=[TAKE], num_takes=1500), "lab", "1 of 1500")


@pytest.mark.parametrize(
    "content",
    [
        {},
        {"takes": 5, "num_takes": "x", "kept_s": None},
        {"takes": [5, None, {}, {"name": "\x1b[2J", "bytes": "x", "begin_utime": 1e300, "seconds": 1e299}]},
        {"takes": [{"name": "x" * 10_000, "begin_utime": -5, "seconds": float("nan")}]},
    ],
)
def test_what_another_gateway_sends_is_shown_as_far_as_possible(content: Any) -> None:
    assert "\x1b[2J" not in written(**content)


PARAMETERS = Parameters(markers=Parameters3D(100.0, "mm", (Marker("1", "head[red]"), Marker("2", "foot"))))


def take(folder: Path) -> Path:
    messages = [description(), parameters(PARAMETERS)]
    messages += [markers(2, number) for number in range(100) if number not in (50, 51)]
    path = write_take(folder / "lab.lcmlog", messages)
    path.write_bytes(path.read_bytes()[:-10] + b"garbage")
    return path


def test_the_report_and_json_have_what_is_there_and_what_is_missing(tmp_path: Path) -> None:
    path = str(take(tmp_path))
    words = " ".join(CliRunner().invoke(app, ["take", "info", path]).stdout.split())
    assert "Source lab: 192.0.2.20:3020, gateway 1.0" in words
    assert "3d 97 2 100 of 100 0.98 2 1, 2 at 0.52 s" in words
    assert "head[red] 100.0 %" in words
    assert "lab.lcmlog: 125 bytes from" in words
    found = json.loads(CliRunner().invoke(app, ["take", "info", path, "--json"]).stdout)
    part = found["sources"]["lab"]["components"]["3d"]
    assert (part["messages"], part["missing"], part["largest_gap"]) == (97, 2, {"at_s": 0.52, "missing": 2})
    assert part["visible"] == {"head[red]": 1.0, "foot": 1.0}
    assert (found["damage"]["places"], found["is_complete"]) == (1, False)


def test_what_is_incomplete_comes_first(tmp_path: Path) -> None:
    """Below the tables of a long take, nobody would read that its end is missing."""
    about = SourceDescription("lab", "MOCAP_LAB")
    messages = [(channel.decode(), each) for channel, each in about.beginning("walk", START_UTIME)]
    channel, end = about.end(START_UTIME, 7)
    for name, rest, num_incomplete in (
        ("a", [markers(2)], 1),  # the end is missing
        ("b", [markers(2), (channel.decode(), end)], 1),
        ("c", [markers(2), (channel.decode(), about.end(START_UTIME, 0)[1])], 0),
    ):
        path = write_take(tmp_path / f"{name}.lcmlog", [*messages, *rest])
        result = CliRunner().invoke(app, ["take", "info", str(path)])
        lines = result.stdout.splitlines()
        assert [line.startswith("INCOMPLETE") for line in lines].count(True) == num_incomplete
        assert lines[2].startswith("INCOMPLETE") == bool(num_incomplete)
        assert result.exit_code == num_incomplete


def test_a_file_that_is_no_recording_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\r\n" * 100)
    result = CliRunner().invoke(app, ["take", "info", str(tmp_path / "picture.png")])
    assert isinstance(result.exception, TakeError)
    assert names(str(result.exception), "picture.png")
