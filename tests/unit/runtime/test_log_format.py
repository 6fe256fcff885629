import json
import logging
import os
import re
import sys
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from gateway.errors import ConfigError
from gateway.runtime.failures import log_fields
from gateway.runtime.log_format import JournalHandler, LogFormat, LogLevel, set_up_log
from tests.support.errors import raises

LOGGER = logging.getLogger("tests.log_format")


ROOT = logging.getLogger()


@pytest.fixture(autouse=True)
def _restore_root_logger() -> Iterator[None]:
    level = ROOT.level
    yield
    ROOT.handlers.clear()
    ROOT.setLevel(level)


def set_up(level: LogLevel, log_format: LogFormat = LogFormat.AUTO) -> None:
    ROOT.handlers.clear()  # with pytest's handlers there, basicConfig would do nothing
    set_up_log(level, log_format)


@pytest.fixture
def journal(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Replace cysystemd, an optional extra, and return the list of the entries that are sent."""
    sent: list[dict[str, Any]] = []
    package, module = ModuleType("cysystemd"), ModuleType("cysystemd.journal")
    vars(module)["send"] = lambda **entry: sent.append(entry)
    vars(package)["journal"] = module
    monkeypatch.setitem(sys.modules, "cysystemd", package)
    monkeypatch.setitem(sys.modules, "cysystemd.journal", module)
    return sent


def uninstall_cysystemd(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cysystemd", None)  # makes the import fail


def test_text_has_time_level_and_message(capsys: pytest.CaptureFixture[str]) -> None:
    set_up(LogLevel.INFO, LogFormat.TEXT)
    LOGGER.warning("lab: %d frames", 7)
    line = capsys.readouterr().err
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} WARNING lab: 7 frames\n", line)


@pytest.mark.parametrize("level", LogLevel)
def test_a_level_includes_itself_and_all_higher_levels(
    level: LogLevel, capsys: pytest.CaptureFixture[str]
) -> None:
    set_up(level, LogFormat.TEXT)
    for each in LogLevel:
        LOGGER.log(logging.getLevelNamesMapping()[each.upper()], "%s", each.value)
    logged = [line.rsplit(" ", 1)[-1] for line in capsys.readouterr().err.splitlines()]
    assert logged == [each.value for each in list(LogLevel)[list(LogLevel).index(level) :]]


FIELDS = {"source": "lab", "stream": "3d 6d", "peer": "192.0.2.20:3020"}


def log_a_defect() -> None:
    try:
        int("a defect")
    except ValueError:
        LOGGER.exception("oops")


def test_json_writes_one_object_per_line_with_the_fields(capsys: pytest.CaptureFixture[str]) -> None:
    set_up(LogLevel.INFO, LogFormat.JSON)
    LOGGER.info("two\nlines, µ")
    with log_fields(**FIELDS):
        LOGGER.warning("lab: late")
    log_a_defect()
    first, second, third = map(json.loads, capsys.readouterr().err.splitlines())
    assert datetime.fromisoformat(first.pop("time")).tzinfo is not None
    assert second.pop("time")
    logger = {"logger": "tests.log_format"}
    assert first == {"level": "info", "message": "two\nlines, µ"} | logger
    assert second == {"level": "warning", "message": "lab: late"} | logger | FIELDS
    assert third["exception"].endswith(": 'a defect'")


@pytest.mark.parametrize("log_format", [LogFormat.TEXT, LogFormat.JSON])
def test_text_from_a_network_cannot_forge_a_line(
    log_format: LogFormat, capsys: pytest.CaptureFixture[str]
) -> None:
    set_up(LogLevel.INFO, log_format)
    LOGGER.warning("%s", "\x1b[2J\u202e\x9b\udc80\n2026-01-01 00:00:00,000 ERROR forged" + "x" * 100_000)
    shown = capsys.readouterr().err
    assert r"\x1b[2J\u202e\x9b\udc80" in shown.replace("\\\\", "\\")
    assert len(shown) < 30_000
    assert [line[:1] for line in shown.splitlines()[1:]] == ([" "] if log_format is LogFormat.TEXT else [])


def test_the_journal_receives_message_priority_fields_and_traceback(journal: list[dict[str, Any]]) -> None:
    set_up(LogLevel.DEBUG, LogFormat.JOURNAL)
    with log_fields(**FIELDS):
        LOGGER.warning("lab: %s", "late")
    for level in (logging.DEBUG, logging.INFO, logging.ERROR, logging.CRITICAL):
        LOGGER.log(level, "more")
    log_a_defect()
    entry = {"message": "lab: late", "priority": 4, "syslog_identifier": "rtc3d-gateway"}
    assert journal[0] == entry | {"logger": "tests.log_format"} | FIELDS
    assert [entry["priority"] for entry in journal[1:]] == [7, 6, 3, 2, 3]
    assert "source" not in journal[1]
    assert journal[-1]["message"].startswith("oops\nTraceback")
    assert journal[-1]["message"].endswith(": 'a defect'")


def test_the_journal_without_cysystemd_is_an_error_that_names_the_remedy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    uninstall_cysystemd(monkeypatch)
    with raises(ConfigError, "'rtc3d-gateway[systemd]'"):
        set_up(LogLevel.INFO, LogFormat.JOURNAL)


def handler_for_auto(stderr: Path, monkeypatch: pytest.MonkeyPatch, *, journal_is: Path | None) -> type[Any]:
    """Return the handler's class when stderr is one file and JOURNAL_STREAM names ``journal_is``."""
    monkeypatch.delenv("JOURNAL_STREAM", raising=False)
    if journal_is is not None:
        status = os.stat(journal_is)  # noqa: PTH116 - the same length
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
    with stderr.open("w") as file:
        monkeypatch.setattr(sys, "stderr", file)
        set_up(LogLevel.INFO)
    [handler] = ROOT.handlers
    return type(handler)


@pytest.mark.usefixtures("journal")
def test_auto_uses_the_journal_only_if_stderr_is_the_journal_and_cysystemd_is_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, elsewhere = tmp_path / "here", tmp_path / "elsewhere"
    here.touch()
    elsewhere.touch()
    assert handler_for_auto(here, monkeypatch, journal_is=here) is JournalHandler
    assert handler_for_auto(here, monkeypatch, journal_is=elsewhere) is logging.StreamHandler
    assert handler_for_auto(here, monkeypatch, journal_is=None) is logging.StreamHandler
    uninstall_cysystemd(monkeypatch)
    assert handler_for_auto(here, monkeypatch, journal_is=here) is logging.StreamHandler
