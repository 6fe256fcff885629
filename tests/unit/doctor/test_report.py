import io
import json

from rich.console import Console

from gateway.doctor.finding import Finding, Patient, Result
from gateway.doctor.report import Report

LAB = Patient("lab")


def shown(*findings: Finding, width: int = 60, color: bool = False) -> str:
    out = io.StringIO()
    console = Console(file=out, width=width, force_terminal=color, color_system="standard" if color else None)
    report = Report(console)
    for finding in findings:
        report.add(finding)
    report.end()
    return out.getvalue()


def test_findings_stand_below_their_subject_in_columns() -> None:
    findings = (
        LAB.good("name", "[bold]127.0.0.1[/] is an address"),
        LAB.bad(
            "TCP", "connection refused by 192.0.2.20:3020 :smile:", "Is the RT server running, and is it?"
        ),
        LAB.untested("protocol", "it needs TCP, which failed"),
        Patient("zenoh").good("link", "open"),
    )
    assert shown(*findings) == (
        "lab\n"
        "  ok    name        [bold]127.0.0.1[/] is an address\n"
        "  FAIL  TCP         connection refused by 192.0.2.20:3020\n"
        "                    :smile:\n"
        "                    → Is the RT server running, and is it?\n"
        "  skip  protocol    not tested: it needs TCP, which failed\n"
        "zenoh\n"
        "  ok    link        open\n"
        "2 ok, 1 to put right, 1 not tested\n"
    )


def test_lines_of_their_own_stay_so_and_long_words_stay_whole() -> None:
    path = "/etc/rtc3d-gateway/a-very-long-name-of-a-file.yaml:1:2:"
    text = shown(
        LAB.bad(
            "file",
            f"{path} wrong\nlab.yaml:3:4: wrong",
            "Correct them all, one after the other, and check again.",
        )
    )
    assert text.splitlines()[1:6] == [
        f"  FAIL  file        {path}",
        "                    wrong",
        "                    lab.yaml:3:4: wrong",
        "                    → Correct them all, one after the other,",
        "                      and check again.",
    ]


def test_a_narrow_terminal_still_gets_it_all() -> None:
    assert "connection" in shown(LAB.good("TCP", "connection " * 3), width=10)


def test_red_is_red_and_green_green() -> None:
    text = shown(LAB.good("name", "x"), LAB.bad("TCP", "x", "y"), color=True)
    assert "\x1b[1;32mok" in text
    assert "\x1b[1;31mFAIL" in text
    assert "\x1b[1;31m1 ok, 1 to put right, 0 not tested" in text


def test_json_has_everything() -> None:
    report = Report(Console(quiet=True))
    report.add(LAB.good("name", "ü"))
    assert json.loads(report.as_json())["ok"] is True
    report.add(LAB.bad("TCP", "x", "y"))
    assert json.loads(report.as_json()) == {
        "ok": False,
        "findings": [
            {"subject": "lab", "check": "name", "result": "green", "found": "ü", "remedy": ""},
            {"subject": "lab", "check": "TCP", "result": "red", "found": "x", "remedy": "y"},
        ],
    }


def test_what_was_not_tested_is_not_bad() -> None:
    report = Report(Console(quiet=True))
    report.add(LAB.untested("name", "of it"))
    assert report.is_good
    assert report.findings == [Finding("lab", "name", Result.NOT_TESTED, "of it")]
