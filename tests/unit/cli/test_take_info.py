"""``rtc3d-gateway take info``."""

import json
from pathlib import Path

from typer.testing import CliRunner

from gateway.cli.main import app
from gateway.errors import TakeError
from gateway.rtc3d.parameters import Marker, Parameters, Parameters3D
from tests.takes import description, markers, parameters, write_take

PARAMETERS = Parameters(markers=Parameters3D(100.0, "mm", (Marker("1", "head[red]"), Marker("2", "foot"))))


def take(folder: Path) -> Path:
    messages = [description(), parameters(PARAMETERS)]
    messages += [markers(2, number) for number in range(100) if number not in (50, 51)]
    path = write_take(folder / "lab.lcmlog", messages)
    path.write_bytes(path.read_bytes()[:-10] + b"garbage")
    return path


def test_the_report_shows_what_is_there_and_what_is_missing(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["take", "info", str(take(tmp_path))])
    assert result.exit_code == 0
    words = " ".join(result.stdout.split())
    assert "Source lab: 192.0.2.20:3020, gateway 1.0" in words
    assert "3d 97 2 100 of 100 0.98 2 1, 2 at 0.52 s" in words
    assert "head[red] 100.0 %" in words
    assert "lab.lcmlog: 125 bytes from" in words


def test_json_has_the_same(tmp_path: Path) -> None:
    path = take(tmp_path)
    result = CliRunner().invoke(app, ["take", "info", str(path), "--json"])
    found = json.loads(result.stdout)
    part = found["sources"]["lab"]["components"]["3d"]
    assert (part["messages"], part["missing"], part["largest_gap"]) == (97, 2, {"at_s": 0.52, "missing": 2})
    assert part["visible"] == {"head[red]": 1.0, "foot": 1.0}
    assert found["damage"]["places"] == 1
    assert found["is_complete"] is False


def test_a_file_that_is_no_recording_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\r\n" * 100)
    result = CliRunner().invoke(app, ["take", "info", str(tmp_path / "picture.png")])
    assert isinstance(result.exception, TakeError)
    assert "choose a recording" in str(result.exception)
