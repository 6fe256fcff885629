"""The forms in which ``params`` writes what servers told."""

import io
import json

import pytest

from gateway.cli.params_tables import Form, Told, show
from gateway.messages.decode import to_json
from gateway.rtc3d.commands import SECTIONS
from tests.spec_parameters import ALL, in_root, spec_body, spec_xml

EVERYTHING = in_root(*(spec_body(section).decode() for section in ("general", "3d", "6d", "analog")))


def shown(form: Form, *told: Told) -> tuple[str, list[tuple[str, str]]]:
    """Return what is written, in a wide terminal, and code and text of what is wrong."""
    buffer = io.BytesIO()
    out = io.TextIOWrapper(buffer, encoding="utf-8", write_through=True)
    problems = show(told, form, out)
    return buffer.getvalue().decode(), [(problem.code, str(problem)) for problem in problems]


@pytest.fixture(autouse=True)
def wide_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "240")


def cells(text: str) -> list[list[str]]:
    """Return the contents of the tables' rows."""
    lines = [line for line in text.splitlines() if line.startswith("│")]
    return [[cell.strip() for cell in line.strip("│").split("│")] for line in lines]


@pytest.mark.parametrize(
    ("section", "title", "rows"),
    [
        ("general", "lab: general", [["version", "1.02.03"], ["port", "12345"], ["frames per s", "33.12"]]),
        ("3d", "lab: 3D, 1 marker, 60 Hz, mm", [["1", "1", "marker 1", ""]]),
        ("6d", "lab: 6D, 1 tool, 60 Hz", [["1", "1", "", "", "12 14 20"]]),
        ("analog", "lab: analog, 1 channel", [["1", "1", "EMG1", "", "mV", "2400"]]),
        (
            "force",
            "lab: force, 1 plate",
            [
                ["1", "1", "First force plate", "2400", "1000 0 0 mm", "-4 5 -40 mm", "Force X N",
                 "analog channel id 6 7 8 8 10", "1 × 6 microV"],
                ["", "", "", "", "1600 0 0 mm", "", "Force Y N", "", "gain 4000"],
                ["", "", "", "", "1600 400 0 mm", "", "Moment Z Nm", "", "5 V"],
                ["", "", "", "", "1000 400 0 mm", "", "", "", ""],
            ],
        ),
        (
            "events",
            "lab: events, 1 kind",
            [
                ["0x123456", "Button", "Button action", "1 int Button id number"],
                ["", "", "", "2 int ON/OFF state (1 ON, 0 OFF)"],
            ],
        ),
    ],
)  # fmt: skip
def test_each_section_is_a_table(section: str, title: str, rows: list[list[str]]) -> None:
    text, problems = shown("table", Told("lab", (section,), spec_xml(section), 0.44))
    assert problems == []
    assert text.splitlines()[0].rstrip() == title
    assert [row for row in rows if row not in cells(text)] == []
    assert text.splitlines()[-1] == "lab: the server said so 0.4 s ago"


def test_the_sections_asked_for_are_shown_and_no_others() -> None:
    text, problems = shown("table", Told("lab", ("6d", "3d"), EVERYTHING, None))
    titles = [line.rstrip() for line in text.splitlines() if line.startswith("lab:")]
    assert titles == ["lab: 3D, 1 marker, 60 Hz, mm", "lab: 6D, 1 tool, 60 Hz"]
    assert problems == []


def test_of_everything_what_is_there_is_shown() -> None:
    text, problems = shown("table", Told("lab", (), EVERYTHING, 0.0))
    titles = [line.split(",")[0].rstrip() for line in text.splitlines() if line.startswith("lab:")]
    assert titles == [
        "lab: general",
        "lab: 3D",
        "lab: 6D",
        "lab: analog",
        "lab: the server said so 0.0 s ago",
    ]
    assert problems == []


def test_each_source_is_shown_under_its_name() -> None:
    text, _ = shown("table", *(Told(name, ("3d",), spec_xml("3d"), 1.0) for name in ("lab", "hall")))
    assert "lab: 3D, 1 marker" in text
    assert "hall: 3D, 1 marker" in text


def test_labels_of_a_server_steer_no_terminal_and_are_no_markup() -> None:
    marker = "<Markers><Marker id='1'><Label>[bold]L</Label></Marker></Markers>"
    xml = in_root(f"<The_3D><Unit>[red]\u202emm</Unit>{marker}</The_3D>")
    text, _ = shown("table", Told("lab", ("3d",), xml, 0.0))
    assert "[red]\N{REPLACEMENT CHARACTER}mm" in text
    assert ["1", "1", "[bold]L", ""] in cells(text)


def test_json_has_every_source_with_its_sections_and_age() -> None:
    told = [Told("lab", (section,), spec_xml(section), 0.1) for section in SECTIONS]
    text, problems = shown("json", *told, Told("hall", ("3d",), spec_xml("3d"), None))
    value = json.loads(text)
    assert list(value) == ["lab", "hall"]
    expected = dict(zip(SECTIONS, to_json(ALL).values(), strict=True))
    assert value["lab"] == {"age_s": 0.1, "parameters": expected}
    assert value["hall"]["age_s"] is None
    assert problems == []


def test_xml_is_written_as_it_came() -> None:
    text, problems = shown("xml", Told("lab", ("force",), spec_xml("force") + b"\0", 0.0))
    assert text.encode() == spec_xml("force").rstrip() + b"\n"
    assert problems == []


def test_several_pieces_of_xml_are_told_apart_by_a_comment() -> None:
    text, _ = shown("xml", Told("lab", ("3d",), b"<a/>", 0.0), Told("hall", (), b"<b/>\n", 0.0))
    assert text == "<!-- lab 3d -->\n<a/>\n<!-- hall  -->\n<b/>\n"


@pytest.mark.parametrize("form", ["table", "json"])
def test_a_section_that_is_not_there_is_a_problem_and_the_others_are_shown(form: Form) -> None:
    text, problems = shown(form, Told("lab", ("3d", "events"), spec_xml("3d"), 0.0))
    assert problems == [("nothing-yet", "source 'lab': the server's answer has no section events")]
    assert "marker 1" in text


def test_xml_that_cannot_be_read_is_a_problem_and_other_sources_are_shown() -> None:
    text, problems = shown("table", Told("lab", (), b"3 o'clock", 0.0), Told("hall", (), EVERYTHING, 0.0))
    [(code, problem)] = problems
    assert code == "unreadable"
    assert problem.startswith("source 'lab': ")
    assert problem.endswith("see it with --xml")
    assert "hall: 3D, 1 marker" in text
