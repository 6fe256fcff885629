import asyncio
import logging
import re
from collections.abc import Iterator

import pytest

from gateway.log import FIELDS, FailureLog, FieldsFilter, log_fields

LOGGER = logging.getLogger("tests.failures")


@pytest.fixture(autouse=True)
def _every_level(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, LOGGER.name)


def levels(caplog: pytest.LogCaptureFixture) -> list[int]:
    return [record.levelno for record in caplog.records]


def test_the_first_failure_is_a_warning_with_subject_and_text(caplog: pytest.LogCaptureFixture) -> None:
    FailureLog(LOGGER, "lab").failed("no answer; check the cable")
    assert caplog.record_tuples == [(LOGGER.name, logging.WARNING, "lab: no answer; check the cable")]


def test_repeats_are_told_quietly_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    failures = FailureLog(LOGGER, "lab")
    for _ in range(3):
        failures.failed("no answer")
    assert levels(caplog) == [logging.WARNING, logging.DEBUG, logging.DEBUG]
    assert caplog.messages[1:] == [
        "lab: no answer (failure 2 in a row)",
        "lab: no answer (failure 3 in a row)",
    ]


def test_recovery_is_told_with_how_long_and_how_often_it_failed(caplog: pytest.LogCaptureFixture) -> None:
    failures = FailureLog(LOGGER, "lab")
    failures.failed("no answer")
    failures.failed("no answer")
    failures.recovered("streaming")
    assert levels(caplog)[-1] == logging.INFO
    assert re.fullmatch(r"lab: streaming, after \d+\.\d s and 2 failures", caplog.messages[-1])


def test_what_had_not_failed_is_told_without_a_count(caplog: pytest.LogCaptureFixture) -> None:
    failures = FailureLog(LOGGER, "lab")
    failures.recovered("streaming")
    failures.failed("no answer")
    failures.recovered("streaming")
    failures.recovered("streaming")
    assert levels(caplog) == [logging.INFO, logging.WARNING, logging.INFO, logging.INFO]
    assert caplog.messages[0] == caplog.messages[3] == "lab: streaming"


def test_a_failure_after_recovery_is_a_warning_again(caplog: pytest.LogCaptureFixture) -> None:
    failures = FailureLog(LOGGER, "lab")
    for _ in range(2):
        failures.failed("no answer")
        failures.recovered("streaming")
    assert levels(caplog) == [logging.WARNING, logging.INFO] * 2


def test_failing_is_what_was_told_last() -> None:
    failures = FailureLog(LOGGER, "lab")
    told = [failures.failing]
    failures.failed("no answer")
    told.append(failures.failing)
    failures.recovered("streaming")
    told.append(failures.failing)
    assert told == [False, True, False]


def test_what_fails_by_turns_is_over_once_it_has_worked_for_long_enough(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 0.0
    monkeypatch.setattr("gateway.log.time.monotonic", lambda: now_s)
    failures = FailureLog(LOGGER, "lab", hold_s=5.0)
    for second in range(4):
        now_s = float(second)
        failures.failed("too large")
        failures.recovered("messages go out")
    assert levels(caplog) == [logging.WARNING, *[logging.DEBUG] * 3]
    assert failures.failing
    now_s = 8.0
    failures.recovered("messages go out")
    assert caplog.messages[-1] == "lab: messages go out, after 8.0 s and 4 failures"
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
    """Collect what a handler with the filter is given."""
    handler = Collector()
    handler.addFilter(FieldsFilter())
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


async def test_tasks_and_callbacks_have_the_fields_of_where_they_were_started(
    records: list[logging.LogRecord],
) -> None:
    async def run(source: str) -> None:
        with log_fields(source=source):
            asyncio.get_running_loop().call_soon(LOGGER.warning, "callback")
            await asyncio.create_task(asyncio.sleep(0))
            LOGGER.warning("task")

    await asyncio.gather(run("hall"), run("lab"))
    told = [(fields(record)["source"], record.getMessage()) for record in records]
    assert sorted(told) == [("hall", "callback"), ("hall", "task"), ("lab", "callback"), ("lab", "task")]
