import io
import json

from rich.console import Console

from gateway.outputs.findings import NO_CONFIGURATION, Check, Finding, Result
from gateway.tools.doctor.report import Report


def reported(*findings: Finding, console: Console | None = None, quiet: bool = False) -> Report:
    report = Report(console or Console(quiet=True), quiet=quiet)
    for finding in findings:
        report.add(finding)
    report.end()
    return report


def shown(*findings: Finding, width: int = 60, color: bool = False, quiet: bool = False) -> str:
    out = io.StringIO()
    console = Console(file=out, width=width, force_terminal=color, color_system="standard" if color else None)
    reported(*findings, console=console, quiet=quiet)
    return out.getvalue()


def in_json(report: Report) -> list[dict[str, str]]:
    findings: list[dict[str, str]] = json.loads(report.as_json())["findings"]
    return findings


def test_findings_are_printed_in_columns_below_their_subject() -> None:
    findings = (
        Check("lab", "name").passing("[bold]127.0.0.1[/] is an address"),
        Check("lab", "TCP").failing(
            "connection refused by 192.0.2.20:3020 :smile:", "Is the RT server running, is it?"
        ),
        Check("lab", "protocol").not_tested("it needs TCP, which failed"),
        Check("zenoh", "link").passing("open"),
    )
    assert shown(*findings) == (
        "lab\n"
        "  ok    name        [bold]127.0.0.1[/] is an address\n"
        "  FAIL  TCP         connection refused by 192.0.2.20:3020\n"
        "                    :smile:\n"
        "                    → Is the RT server running, is it?\n"
        "  skip  protocol    not tested: it needs TCP, which failed\n"
        "zenoh\n"
        "  ok    link        open\n"
        "2 ok, 1 failed, 1 not tested\n"
    )
    assert "connection" in shown(Check("lab", "TCP").passing("connection " * 3), width=10)
    text = shown(*findings, color=True)
    for part in ("\x1b[1;32mok", "\x1b[1;31mFAIL", "\x1b[1;31m2 ok, 1 failed, 1 not tested"):
        assert part in text


def test_checks_that_need_a_valid_configuration_get_one_line() -> None:
    findings = (
        Check("configuration", "file").failing("lab.yaml:1:2: wrong", "Correct it."),
        *(Check("source", name).not_tested(NO_CONFIGURATION) for name in ("name", "TCP")),
        Check("zenoh", "link").not_tested(NO_CONFIGURATION),
        Check("this computer", "clock").passing("right"),
    )
    assert shown(*findings, width=100) == (
        "configuration\n"
        "  FAIL  file        lab.yaml:1:2: wrong\n"
        "                    → Correct it.\n"
        "sources and outputs\n"
        "  skip  all         not tested: correct the configuration first, then run the doctor again\n"
        "this computer\n"
        "  ok    clock       right\n"
        "1 ok, 1 failed, 3 not tested\n"
    )


def test_warnings_and_notes_are_counted_and_do_not_fail() -> None:
    findings = (
        Check("lab", "loss").warning("12 messages", "Look."),
        Check("lab", "rate").note("no rate to compare with"),
        Check("lab", "frames").note("no 6d", "Enable it."),
    )
    assert shown(*findings) == (
        "lab\n"
        "  warn  loss        12 messages\n"
        "                    → Look.\n"
        "  note  rate        no rate to compare with\n"
        "  note  frames      no 6d\n"
        "                    → Enable it.\n"
        "0 ok, 0 failed, 0 not tested, 1 warning, 2 notes\n"
    )
    report = reported(*findings)
    assert report.is_ok
    assert [each["result"] for each in in_json(report)] == ["warning", "note", "note"]


def test_two_streams_of_a_source_are_named_apart() -> None:
    streams = (Check("lab", "frames", "3d 6d"), Check("lab", "frames", "analog"))
    findings = [Check("lab", "TCP").passing("x"), *(stream.passing("y") for stream in streams)]
    lines = shown(*findings).splitlines()
    assert lines[::2] == ["lab", "lab (3d 6d)", "lab (analog)", "3 ok, 0 failed, 0 not tested"]
    assert [each.get("stream") for each in in_json(reported(*findings))] == [None, "3d 6d", "analog"]


def test_line_breaks_are_kept_and_long_words_are_not_split() -> None:
    path = "/etc/rtc3d-gateway/a-very-long-name-of-a-file.yaml:1:2:"
    remedy = "Correct them all, one after the other, and check again."
    text = shown(Check("lab", "file").failing(f"{path} wrong\nlab.yaml:3:4: wrong", remedy))
    assert [line[20:] for line in text.splitlines()[1:6]] == [
        path,
        "wrong",
        "lab.yaml:3:4: wrong",
        "→ Correct them all, one after the other,",
        "  and check again.",
    ]


def test_json_has_every_field_of_every_finding() -> None:
    passing, failing = Check("lab", "name").passing("ü"), Check("lab", "TCP").failing("x", "y")
    assert json.loads(reported(passing).as_json())["ok"] is True
    assert json.loads(reported(passing, failing).as_json()) == {
        "ok": False,
        "findings": [
            {"subject": "lab", "check": "name", "result": "green", "found": "ü", "remedy": ""},
            {"subject": "lab", "check": "TCP", "result": "red", "found": "x", "remedy": "y"},
        ],
    }
    report = reported(Check("lab", "name").not_tested("no frames"))
    assert (report.is_ok, report.findings) == (True, [Finding("lab", "name", Result.NOT_TESTED, "no frames")])


def test_an_output_that_is_not_enabled_has_one_line() -> None:
    checks = ("route", "requests", "buffers")
    findings = (
        Check("zenoh", "link").passing("open"),
        *(Check("lcm", name).not_tested("lcm.enabled is false") for name in checks),
        *(Check("takes", name).not_tested("takes.enabled is false") for name in ("folder", "space")),
        Check("this computer", "clock").passing("synchronised"),
    )
    assert shown(*findings) == (
        "zenoh\n"
        "  ok    link        open\n"
        "outputs that are not enabled\n"
        "  skip  lcm         not tested: lcm.enabled is false\n"
        "  skip  takes       not tested: takes.enabled is false\n"
        "this computer\n"
        "  ok    clock       synchronised\n"
        "2 ok, 0 failed, 0 not tested\n"
    )
    found = [each["check"] for each in in_json(reported(*findings)) if each["subject"] == "lcm"]
    assert found == [*checks]


def test_a_quiet_report_has_only_warnings_and_failures() -> None:
    findings = (
        Check("lab", "name").passing("fine"),
        Check("hall", "TCP").failing("refused", "Start it."),
        Check("hall", "protocol").not_tested("it needs TCP"),
        Check("zenoh", "link").warning("slow", "Look."),
    )
    assert shown(*findings, quiet=True) == (
        "hall\n"
        "  FAIL  TCP         refused\n"
        "                    → Start it.\n"
        "zenoh\n"
        "  warn  link        slow\n"
        "                    → Look.\n"
    )
    assert not reported(*findings).is_ok
