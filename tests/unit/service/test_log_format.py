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
from gateway.log import log_fields
from gateway.service.log_format import JournalHandler, LogFormat, LogLevel, set_up_log

LOGGER = logging.getLogger("tests.forms")


ROOT = logging.getLogger()


@pytest.fixture(autouse=True)
def _root_as_before() -> Iterator[None]:
    level = ROOT.level
    yield
    ROOT.handlers.clear()
    ROOT.setLevel(level)


def set_up(level: LogLevel, log_format: LogFormat = LogFormat.AUTO) -> None:
    ROOT.handlers.clear()  # pytest's own, beside which nothing would be set up
    set_up_log(level, log_format)


@pytest.fixture
def journal(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Stand in for cysystemd, which is an extra: what would be sent is in the list."""
    sent: list[dict[str, Any]] = []
    package, module = ModuleType("cysystemd"), ModuleType("cysystemd.journal")
    vars(module)["send"] = lambda **entry: sent.append(entry)
    vars(package)["journal"] = module
    monkeypatch.setitem(sys.modules, "cysystemd", package)
    monkeypatch.setitem(sys.modules, "cysystemd.journal", module)
    return sent


def no_journal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cysystemd", None)  # import of it fails


def test_text_is_time_level_and_message(capsys: pytest.CaptureFixture[str]) -> None:
    set_up(LogLevel.INFO, LogFormat.TEXT)
    with log_fields(source="lab"):
        LOGGER.warning("lab: %d frames", 7)
    assert re.fullmatch(
        r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} WARNING lab: 7 frames\n", capsys.readouterr().err
    )


@pytest.mark.parametrize("level", LogLevel)
def test_a_level_holds_itself_and_what_is_graver(level: LogLevel, capsys: pytest.CaptureFixture[str]) -> None:
    set_up(level, LogFormat.TEXT)
    for each in LogLevel:
        LOGGER.log(logging.getLevelNamesMapping()[each.upper()], "%s", each.value)
    told = [line.rsplit(" ", 1)[-1] for line in capsys.readouterr().err.splitlines()]
    assert told == [each.value for each in list(LogLevel)[list(LogLevel).index(level) :]]


def test_json_is_one_object_a_line_with_the_fields(capsys: pytest.CaptureFixture[str]) -> None:
    set_up(LogLevel.INFO, LogFormat.JSON)
    LOGGER.info("two\nlines, µ")
    with log_fields(source="lab", stream="3d 6d", peer="192.0.2.20:3020"):
        LOGGER.warning("lab: late")
    first, second = map(json.loads, capsys.readouterr().err.splitlines())
    time = datetime.fromisoformat(first.pop("time"))
    assert time.tzinfo is not None
    assert first == {"level": "info", "message": "two\nlines, µ", "logger": "tests.forms"}
    assert second.pop("time")
    assert second == {
        "level": "warning",
        "message": "lab: late",
        "logger": "tests.forms",
        "source": "lab",
        "stream": "3d 6d",
        "peer": "192.0.2.20:3020",
    }


def test_json_has_the_traceback_in_its_line(capsys: pytest.CaptureFixture[str]) -> None:
    set_up(LogLevel.INFO, LogFormat.JSON)
    try:
        int("a defect")
    except ValueError:
        LOGGER.exception("oops")
    [line] = capsys.readouterr().err.splitlines()
    assert json.loads(line)["exception"].endswith(": 'a defect'")


def test_the_journal_gets_message_priority_and_fields(journal: list[dict[str, Any]]) -> None:
    set_up(LogLevel.DEBUG, LogFormat.JOURNAL)
    with log_fields(source="lab", stream="3d", peer="192.0.2.20:3020"):
        LOGGER.warning("lab: %s", "late")
    for level in (logging.DEBUG, logging.INFO, logging.ERROR, logging.CRITICAL):
        LOGGER.log(level, "more")
    assert journal[0] == {
        "message": "lab: late",
        "priority": 4,
        "syslog_identifier": "rtc3d-gateway",
        "logger": "tests.forms",
        "source": "lab",
        "stream": "3d",
        "peer": "192.0.2.20:3020",
    }
    assert [entry["priority"] for entry in journal[1:]] == [7, 6, 3, 2]
    assert "source" not in journal[1]


def test_a_traceback_goes_to_the_journal_with_its_message(journal: list[dict[str, Any]]) -> None:
    set_up(LogLevel.INFO, LogFormat.JOURNAL)
    try:
        int("a defect")
    except ValueError:
        LOGGER.exception("oops")
    [entry] = journal
    assert entry["message"].startswith("oops\nTraceback")
    assert entry["message"].endswith(": 'a defect'")


def test_the_journal_without_its_library_is_an_error_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    no_journal(monkeypatch)
    with pytest.raises(ConfigError, match=re.escape("pip install 'rtc3d-gateway[systemd]'")):
        set_up(LogLevel.INFO, LogFormat.JOURNAL)


# Where auto writes ---------------------------------------------------------------------------


def handler_of_auto(stderr: Path, monkeypatch: pytest.MonkeyPatch, *, journal_is: Path | None) -> type[Any]:
    """Return the kind of handler when stderr is one file and the journal, as systemd says, another."""
    monkeypatch.delenv("JOURNAL_STREAM", raising=False)
    if journal_is is not None:
        status = os.stat(journal_is)  # noqa: PTH116 - as short
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
    with stderr.open("w") as file:
        monkeypatch.setattr(sys, "stderr", file)
        set_up(LogLevel.INFO)
    [handler] = ROOT.handlers
    return type(handler)


@pytest.mark.usefixtures("journal")
def test_auto_is_the_journal_only_where_stderr_is_the_journal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, elsewhere = tmp_path / "here", tmp_path / "elsewhere"
    here.touch()
    elsewhere.touch()
    assert handler_of_auto(here, monkeypatch, journal_is=here) is JournalHandler
    assert handler_of_auto(here, monkeypatch, journal_is=elsewhere) is logging.StreamHandler
    assert handler_of_auto(here, monkeypatch, journal_is=None) is logging.StreamHandler


def test_auto_writes_text_to_the_journal_without_its_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    no_journal(monkeypatch)
    here = tmp_path / "here"
    here.touch()
    assert handler_of_auto(here, monkeypatch, journal_is=here) is logging.StreamHandler
