"""What ``params`` writes: tables, JSON and XML."""

import io
import json
import re

import pytest

from gateway.client.transport import QueryReply
from gateway.messages.decode import to_json
from gateway.rtc3d.parameters import SECTIONS
from gateway.tools.cli.params import OutputFormat, write_replies
from tests.support.errors import names
from tests.support.parameters import ALL, in_root, spec_body, spec_xml

EVERYTHING = in_root(*(spec_body(section).decode() for section in ("general", "3d", "6d", "analog")))


def reply(source: str, sections: tuple[str, ...], xml: bytes, age_s: float | None = 0.0) -> QueryReply:
    return QueryReply(source, sections, xml, {"age_s": age_s})


def written(output_format: OutputFormat, *replies: QueryReply) -> tuple[str, list[tuple[str, str]]]:
    """Return the text written, and code and text of each problem."""
    buffer = io.BytesIO()
    out = io.TextIOWrapper(buffer, encoding="utf-8", write_through=True)
    problems = write_replies(replies, output_format, out)
    text = re.sub(r"\x1b\[[\d;]*m", "", buffer.getvalue().decode())  # bold and italic
    return text, [(problem.code, str(problem)) for problem in problems]


@pytest.fixture
def wide_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("COLUMNS", "240"), ("TTY_COMPATIBLE", "1"), ("TERM", "xterm")):
        monkeypatch.setenv(name, value)


def cells(text: str) -> list[list[str]]:
    """Return the cells of the tables' rows that are not empty."""
    return [re.split("  +", line.strip()) for line in text.splitlines()]


@pytest.mark.parametrize(
    ("section", "title", "rows"),
    [
        ("general", "lab: general", [["version", "1.02.03"], ["port", "12345"], ["frames per s", "33.12"]]),
        ("3d", "lab: 3D, 1 marker, 60 Hz, mm", [["1", "1", "marker 1"]]),
        ("6d", "lab: 6D, 1 tool, 60 Hz", [["1", "1", "12 14 20"]]),
        ("analog", "lab: analog, 1 channel", [["1", "1", "EMG1", "mV", "2400"]]),
        (
            "force",
            "lab: force, 1 plate",
            [
                ["1", "1", "First force plate", "2400", "1000 0 0 mm", "-4 5 -40 mm", "Force X N",
                 "analog channel id 6 7 8 8 10", "1 × 6 microV"],
                ["1600 0 0 mm", "Force Y N", "gain 4000"],
                ["1600 400 0 mm", "Moment Z Nm", "5 V"],
                ["1000 400 0 mm"],
            ],
        ),
        (
            "events",
            "lab: events, 1 type",
            [
                ["0x123456", "Button", "Button action", "1 int Button id number"],
                ["2 int ON/OFF state (1 ON, 0 OFF)"],
            ],
        ),
    ],
)  # fmt: skip
@pytest.mark.usefixtures("wide_terminal")
def test_each_section_is_a_table(section: str, title: str, rows: list[list[str]]) -> None:
    text, problems = written("table", reply("lab", (section,), spec_xml(section), 0.44))
    assert problems == []
    assert text.splitlines()[0].rstrip() == title
    assert [row for row in rows if row not in cells(text)] == []
    assert text.splitlines()[-1] == "lab: parameters are 0.4 s old"


@pytest.mark.parametrize(
    ("sections", "titles"),
    [
        (("6d", "3d"), ["3D, 1 marker, 60 Hz, mm", "6D, 1 tool, 60 Hz"]),
        ((), ["general", "3D, 1 marker, 60 Hz, mm", "6D, 1 tool, 60 Hz", "analog, 1 channel"]),
    ],
    ids=["those requested", "all that exist"],
)
@pytest.mark.usefixtures("wide_terminal")
def test_only_requested_sections_are_written(sections: tuple[str, ...], titles: list[str]) -> None:
    text, problems = written("table", reply("lab", sections, EVERYTHING, None))
    found = [line.rstrip() for line in text.splitlines() if line.startswith("lab:")]
    assert (found, problems) == ([f"lab: {title}" for title in titles], [])


@pytest.mark.usefixtures("wide_terminal")
def test_labels_cannot_control_the_terminal_and_are_not_markup() -> None:
    marker = "<Markers><Marker id='1'><Label>[bold]L</Label></Marker></Markers>"
    xml = in_root(f"<The_3D><Unit>[red]\u202emm</Unit>{marker}</The_3D>")
    text, _ = written("table", reply("lab", ("3d",), xml))
    assert r"[red]\u202emm" in text
    assert ["1", "1", "[bold]L"] in cells(text)


def test_without_a_terminal_there_is_one_line_for_each_item(capsys: pytest.CaptureFixture[str]) -> None:
    """So that grep and awk find whole records, whatever the width of the terminal."""
    text, _ = written("table", reply("lab", ("6d",), EVERYTHING), reply("lab", ("force",), spec_xml("force")))
    corners = "1000 0 0 mm, 1600 0 0 mm, 1600 400 0 mm, 1000 400 0 mm"
    channels = "Force X N, Force Y N, Moment Z Nm"
    plate = f"1\t1\tFirst force plate\t2400\t{corners}\t-4 5 -40 mm\t{channels}\t"
    assert text.splitlines() == [
        "lab\t6d\t1\t1\t\t\t12 14 20",
        f"lab\tforce\t{plate}analog channel id 6 7 8 8 10\t1 × 6 microV, gain 4000, 5 V",
    ]
    assert capsys.readouterr().err == "lab: parameters are 0.0 s old\n"


def test_json_has_sections_and_age_of_every_source() -> None:
    replies = [reply("lab", (section,), spec_xml(section), 0.1) for section in SECTIONS]
    text, problems = written("json", *replies, reply("hall", ("3d",), spec_xml("3d"), None))
    value = json.loads(text)
    assert list(value) == ["lab", "hall"]
    expected = dict(zip(SECTIONS, to_json(ALL).values(), strict=True))
    assert value["lab"] == {"age_s": 0.1, "parameters": expected}
    assert value["hall"]["age_s"] is None
    assert problems == []


def test_xml_is_written_unchanged_and_after_a_comment_with_the_source_if_there_are_several() -> None:
    text, problems = written("xml", reply("lab", ("force",), spec_xml("force") + b"\0"))
    assert (text.encode(), problems) == (spec_xml("force").rstrip() + b"\n", [])
    text, _ = written("xml", reply("lab", ("3d",), b"<a/>"), reply("hall", (), b"<b/>\n"))
    assert text == "<!-- lab 3d -->\n<a/>\n<!-- hall  -->\n<b/>\n"


@pytest.mark.parametrize("output_format", ["table", "json"])
def test_a_missing_section_is_a_problem_and_other_sections_are_written(output_format: OutputFormat) -> None:
    text, problems = written(output_format, reply("lab", ("3d", "events"), spec_xml("3d")))
    [(code, problem)] = problems
    assert code == "nothing-yet"
    assert names(problem, "'lab'", "events")
    assert "marker 1" in text


def test_unreadable_xml_is_a_problem_and_other_sources_are_written() -> None:
    text, [(code, problem)] = written("table", reply("lab", (), b"3 o'clock"), reply("hall", (), EVERYTHING))
    assert (code, problem.partition(":")[0]) == ("unreadable", "source 'lab'")
    assert names(problem, "--xml")
    assert "hall\t3d\t1\t" in text
