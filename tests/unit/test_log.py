import logging
import re

import pytest

from gateway.log import FailureLog

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
