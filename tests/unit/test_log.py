import asyncio
import logging
import re
from collections.abc import Iterator

import pytest

from gateway.log import (
    FIELDS,
    HOLD_S,
    MAX_HOLD_S,
    MAX_REPEATS,
    DefectLog,
    EventLog,
    FailureLog,
    log_fields,
)
from gateway.service.log_format import ContextFilter

LOGGER = logging.getLogger("tests.failures")


@pytest.fixture(autouse=True)
def _every_level(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, LOGGER.name)


def levels(caplog: pytest.LogCaptureFixture) -> list[int]:
    return [record.levelno for record in caplog.records]


def test_the_first_failure_is_a_warning_with_subject_and_text(caplog: pytest.LogCaptureFixture) -> None:
    FailureLog(LOGGER, "lab").failed("no answer; check the cable")
    assert caplog.record_tuples == [(LOGGER.name, logging.WARNING, "lab: no answer; check the cable")]


def test_repeats_are_logged_as_debug_with_a_count(caplog: pytest.LogCaptureFixture) -> None:
    failures = FailureLog(LOGGER, "lab")
    for _ in range(3):
        failures.failed("no answer")
    assert levels(caplog) == [logging.WARNING, logging.DEBUG, logging.DEBUG]
    assert caplog.messages[1:] == [
        "lab: no answer (failure 2 in a row)",
        "lab: no answer (failure 3 in a row)",
    ]


def test_recovery_is_logged_with_the_duration_and_failure_count(
    caplog: pytest.LogCaptureFixture,
) -> None:
    failures = FailureLog(LOGGER, "lab")
    failures.failed("no answer")
    failures.failed("no answer")
    failures.recovered("streaming")
    assert levels(caplog)[-1] == logging.INFO
    assert re.fullmatch(r"lab: streaming, after \d+\.\d s and 2 failures", caplog.messages[-1])


def test_recovery_is_not_logged_if_nothing_failed(caplog: pytest.LogCaptureFixture) -> None:
    failures = FailureLog(LOGGER, "lab")
    failures.recovered("streaming")
    failures.failed("no answer")
    failures.recovered("streaming")
    failures.recovered("streaming")
    assert levels(caplog) == [logging.WARNING, logging.INFO]


def test_success_is_always_logged_and_ends_a_failure(caplog: pytest.LogCaptureFixture) -> None:
    failures = FailureLog(LOGGER, "lab")
    failures.succeeded("streaming")
    failures.failed("no answer")
    failures.succeeded("streaming")
    failures.succeeded("streaming")
    assert levels(caplog) == [logging.INFO, logging.WARNING, logging.INFO, logging.INFO]
    assert caplog.messages[0] == caplog.messages[3] == "lab: streaming"
    assert re.fullmatch(r"lab: streaming, after \d+\.\d s and 1 failure", caplog.messages[2])


def test_a_failure_after_recovery_is_a_warning_again(caplog: pytest.LogCaptureFixture) -> None:
    failures = FailureLog(LOGGER, "lab")
    for _ in range(2):
        failures.failed("no answer")
        failures.recovered("streaming")
    assert levels(caplog) == [logging.WARNING, logging.INFO] * 2


def test_failing_is_true_from_failure_to_recovery() -> None:
    failures = FailureLog(LOGGER, "lab")
    values = [failures.failing]
    failures.failed("no answer")
    values.append(failures.failing)
    failures.recovered("streaming")
    values.append(failures.failing)
    assert values == [False, True, False]


def test_intermittent_failures_are_over_after_the_hold_time_without_one(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 0.0
    monkeypatch.setattr("gateway.log.monotonic", lambda: now_s)
    failures = FailureLog(LOGGER, "lab", hold_s=5.0)
    for second in range(4):
        now_s = float(second)
        failures.failed("too large")
        failures.recovered("sending")
    assert levels(caplog) == [logging.WARNING, *[logging.DEBUG] * 3]
    assert failures.failing
    now_s = 8.0
    failures.recovered("sending")
    assert caplog.messages[-1] == "lab: sending, after 8.0 s and 4 failures"
    assert not failures.failing


# Fields --------------------------------------------------------------------------------------


class Collector(logging.Handler):
    def __init__(self) -> None:
        super().__init__()
        self.records: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(record)


@pytest.fixture
def records() -> Iterator[list[logging.LogRecord]]:
    """Collect the records that a handler with the filter receives."""
    handler = Collector()
    handler.addFilter(ContextFilter())
    LOGGER.addHandler(handler)
    yield handler.records
    LOGGER.removeHandler(handler)


def fields(record: logging.LogRecord) -> dict[str, str]:
    return {name: getattr(record, name) for name in FIELDS if hasattr(record, name)}


def test_records_have_the_fields_that_are_set_and_no_others(records: list[logging.LogRecord]) -> None:
    LOGGER.warning("before")
    with log_fields(source="lab"):
        with log_fields(stream="3d", peer="192.0.2.20:3020"):
            LOGGER.warning("inside")
        LOGGER.warning("outside")
    LOGGER.warning("after")
    assert [fields(record) for record in records] == [
        {},
        {"source": "lab", "stream": "3d", "peer": "192.0.2.20:3020"},
        {"source": "lab"},
        {},
    ]


async def test_tasks_and_callbacks_inherit_the_fields_of_the_code_that_starts_them(
    records: list[logging.LogRecord],
) -> None:
    async def run(source: str) -> None:
        with log_fields(source=source):
            asyncio.get_running_loop().call_soon(LOGGER.warning, "callback")
            await asyncio.create_task(asyncio.sleep(0))
            LOGGER.warning("task")

    await asyncio.gather(run("hall"), run("lab"))
    logged = [(fields(record)["source"], record.getMessage()) for record in records]
    assert sorted(logged) == [("hall", "callback"), ("hall", "task"), ("lab", "callback"), ("lab", "task")]


def test_a_defect_is_an_error_with_its_traceback_once_for_each_place(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG)
    defects = DefectLog(logging.getLogger("test"), "lab")
    for text in ("one", "two", "3"):
        try:
            number = int(text)
            [0, 1].remove(number)
        except ValueError as defect:
            defects.log(defect)
    first, again, other = caplog.records
    assert first.levelname == other.levelname == "ERROR"
    assert first.message.startswith("lab: defect in the gateway: ValueError: invalid literal")
    assert first.message.endswith("'one'; report this with the log")
    assert first.exc_info is not None
    assert (again.levelname, again.exc_info) == ("DEBUG", None)
    assert again.message.endswith("'two'; report this with the log (again)")


# What comes again and again ------------------------------------------------------------------


class Clock:
    """Replaces the clock of gateway.log."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 0.0
        monkeypatch.setattr("gateway.log.monotonic", lambda: self.now_s)


def test_an_event_is_logged_some_times_and_then_as_debug(caplog: pytest.LogCaptureFixture) -> None:
    events = EventLog(LOGGER, "lab")
    for _ in range(3 * MAX_REPEATS):
        events.log(logging.WARNING, "renamed", "renamed")
    events.log(logging.INFO, "changed", "changed")
    assert levels(caplog) == [
        *[logging.WARNING] * MAX_REPEATS,
        *[logging.DEBUG] * 2 * MAX_REPEATS,
        logging.INFO,
    ]


def test_the_next_loud_event_says_how_many_were_hidden(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch)
    events = EventLog(LOGGER, "lab")
    for _ in range(MAX_REPEATS + 3):
        events.log(logging.INFO, "renamed", "renamed")
    clock.now_s = 600.0
    for _ in range(2):
        events.log(logging.INFO, "renamed", "renamed")
    assert caplog.messages[-2:] == ["lab: renamed (3 more like this since the last one)", "lab: renamed"]


def test_failures_that_come_and_go_are_logged_some_times(caplog: pytest.LogCaptureFixture) -> None:
    failures = FailureLog(LOGGER, "lab")
    for _ in range(100):
        failures.failed("no router")
        failures.recovered("connected")
    assert levels(caplog) == [
        *[logging.WARNING, logging.INFO] * MAX_REPEATS,
        *[logging.DEBUG] * 2 * (100 - MAX_REPEATS),
    ]


def test_the_hold_time_grows_while_failures_come_back_soon(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch)
    failures = FailureLog(LOGGER, "lab", HOLD_S)
    for second in range(3600):
        clock.now_s = float(second)
        if second % 20 == 0:
            failures.failed("closed")
        failures.recovered("streaming")
    loud = [record for record in caplog.records if record.levelno > logging.DEBUG]
    assert len(loud) == 5
    clock.now_s += MAX_HOLD_S
    failures.recovered("streaming")
    assert not failures.failing


def test_a_log_of_defects_can_continue_a_former_one(caplog: pytest.LogCaptureFixture) -> None:
    former = DefectLog(LOGGER, "lab")
    logs = [former, DefectLog(LOGGER, "lab (3d)", former)]
    for defects in logs:
        try:
            int("x")
        except ValueError as defect:
            defects.log(defect)
    assert levels(caplog) == [logging.ERROR, logging.DEBUG]
    assert [defects.count for defects in logs] == [2, 2]
