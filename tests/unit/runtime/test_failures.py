"""Logging of failures, defects and repeated events: what is loud, what is hidden, and for how long."""

import asyncio
import logging
from collections.abc import Iterator

import pytest

from gateway.runtime.failures import (
    FIELDS,
    HOLD_S,
    MAX_HOLD_S,
    MAX_REPEATS,
    STEADY_REASON_S,
    DefectLog,
    EventLog,
    FailureLog,
    log_fields,
)
from gateway.runtime.log_format import ContextFilter
from tests.support.clocks import Clock
from tests.support.errors import names

LOGGER = logging.getLogger("tests.failures")


@pytest.fixture(autouse=True)
def _clock_and_every_level(
    clock: Clock, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("gateway.runtime.failures.monotonic", clock)
    caplog.set_level(logging.DEBUG, LOGGER.name)


def logged(caplog: pytest.LogCaptureFixture) -> list[tuple[str, str]]:
    return [(record.levelname, record.message) for record in caplog.records]


def levels(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.levelname for record in caplog.records]


def test_a_failure_is_loud_once_and_its_recovery_too(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    """What fails for hours must not fill the log, but its begin and its end must be there."""
    failures = FailureLog(LOGGER, "lab")
    failures.recovered("streaming")
    is_failing = [failures.failing]
    assert logged(caplog) == []
    for _ in range(3):
        failures.failed("no answer; check the cable")
        clock.now_s += 1.5
    is_failing.append(failures.failing)
    failures.recovered("streaming")
    failures.recovered("streaming")
    assert [*is_failing, failures.failing] == [False, True, False]
    assert logged(caplog) == [
        ("WARNING", "lab: no answer; check the cable"),
        ("DEBUG", "lab: no answer; check the cable (failure 2 in a row)"),
        ("DEBUG", "lab: no answer; check the cable (failure 3 in a row)"),
        ("INFO", "lab: streaming, after 4.5 s and 3 failures"),
    ]


def test_success_is_always_logged_and_ends_a_failure(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    """Each connection is logged, and a new failure after it is loud again."""
    failures = FailureLog(LOGGER, "lab")
    failures.succeeded("streaming")
    for _ in range(2):
        failures.failed("no answer")
        clock.now_s += 1.0
        failures.succeeded("streaming")
    failure = [("WARNING", "lab: no answer"), ("INFO", "lab: streaming, after 1.0 s")]
    assert logged(caplog) == [("INFO", "lab: streaming"), *failure, *failure]


def test_intermittent_failures_are_over_after_the_hold_time_without_one(
    clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    """A link that loses every other packet is one failure, not a thousand."""
    failures = FailureLog(LOGGER, "lab", hold_s=5.0)
    for second in range(4):
        clock.now_s = float(second)
        failures.failed("too large")
        failures.recovered("sending")
    clock.now_s = 7.9
    failures.recovered("sending")
    is_failing = [failures.failing]
    clock.now_s = 8.0
    failures.recovered("sending")
    assert [*is_failing, failures.failing] == [True, False]
    assert levels(caplog) == ["WARNING", "DEBUG", "DEBUG", "DEBUG", "INFO"]
    assert caplog.messages[-1] == "lab: sending, after 8.0 s and 4 failures"


@pytest.mark.parametrize(
    ("pause_s", "holds_s"), [(MAX_HOLD_S - 1, [5, 10, 20, 40, 60, 60]), (MAX_HOLD_S, [5, 5, 5])]
)
def test_the_hold_time_doubles_while_failures_come_back_soon(
    clock: Clock, pause_s: float, holds_s: list[float]
) -> None:
    """The wait ends at a minute, and starts again after a minute without a failure."""
    failures = FailureLog(LOGGER, "lab", HOLD_S)
    for hold_s in holds_s:
        failures.failed("closed")
        clock.now_s += hold_s - 0.1
        failures.recovered("streaming")
        is_failing = [failures.failing]
        clock.now_s += 0.1
        failures.recovered("streaming")
        assert [*is_failing, failures.failing] == [True, False], hold_s
        clock.now_s += pause_s


def test_a_changed_reason_is_loud(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    """Whoever reads the log of an outage must find what is wrong now, not only what was wrong first."""
    failures = FailureLog(LOGGER, "lab")
    texts = ["no reply", "no reply", "refused after 1.5 s", "refused after 2.5 s", "unreachable", "no reply"]
    for text in texts:
        failures.failed(text)
        clock.now_s += 1.0
    assert levels(caplog) == ["WARNING", "DEBUG", "WARNING", "DEBUG", "WARNING", "WARNING"]


def test_a_failure_that_lasts_is_loud_every_hour(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    """The hour counts from the newest loud message, so a change postpones the reminder."""
    failures = FailureLog(LOGGER, "lab")
    begin_s = clock.now_s
    loud_s = []
    for second in range(0, 4 * 3600, 10):
        clock.now_s = begin_s + second
        failures.failed("refused" if second < 1800 else "unreachable")
        if caplog.records[-1].levelno == logging.WARNING:
            loud_s.append(second)
    assert loud_s == [0, 1800, 1800 + 3600, 1800 + 2 * 3600, 1800 + 3 * 3600]


@pytest.mark.parametrize("num_reasons", [2, 1000])
def test_reasons_that_change_all_the_time_do_not_fill_the_log(
    clock: Clock, caplog: pytest.LogCaptureFixture, num_reasons: int
) -> None:
    """A server chooses its texts: an hour has at most five changes and one reminder."""
    failures = FailureLog(LOGGER, "lab")
    for number in range(10 * 3600):
        failures.failed(f"refused: {chr(0x4E00 + number % num_reasons)}")
        clock.now_s += 1.0
    num_loud = levels(caplog).count("WARNING")
    assert 10 <= num_loud <= 1 + 10 * (MAX_REPEATS + 1)


def test_after_many_changes_the_reason_that_stays_is_logged(
    clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    """While a server restarts, its reasons change often. The last line must not be one that is long over."""
    failures = FailureLog(LOGGER, "lab")
    for number in range(MAX_REPEATS + 5):
        failures.failed(f"broken: {chr(0x4E00 + number)}")
        clock.now_s += 1.0
    caplog.clear()
    for _ in range(int(2 * STEADY_REASON_S)):
        failures.failed("refused")
        clock.now_s += 1.0
    loud = [index for index, level in enumerate(levels(caplog)) if level == "WARNING"]
    assert loud == [STEADY_REASON_S]


def test_a_new_period_of_failure_has_a_reminder_of_its_own(
    clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    """Its first failure is loud, so an hour passes before it is repeated."""
    failures = FailureLog(LOGGER, "lab")
    failures.failed("refused")
    failures.recovered("connected")
    clock.now_s += 3599.0
    for _ in range(3):
        failures.failed("refused")
        clock.now_s += 1.0
    assert levels(caplog) == ["WARNING", "INFO", "WARNING", "DEBUG", "DEBUG"]


def test_the_recovery_of_a_failure_that_became_loud_is_loud(
    clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    """The begin of the period was hidden, because many came and went before."""
    failures = FailureLog(LOGGER, "lab")
    for _ in range(MAX_REPEATS + 1):
        failures.failed("no router")
        failures.recovered("connected")
    failures.failed("no router")
    clock.now_s += 3600.0
    failures.failed("no router")
    failures.recovered("connected")
    assert levels(caplog)[-4:] == ["DEBUG", "DEBUG", "WARNING", "INFO"]


def test_failures_that_come_and_go_are_logged_some_times(caplog: pytest.LogCaptureFixture) -> None:
    """The recovery of a hidden failure is hidden, too."""
    failures = FailureLog(LOGGER, "lab")
    for _ in range(100):
        failures.failed("no router")
        failures.recovered("connected")
    assert levels(caplog) == ["WARNING", "INFO"] * MAX_REPEATS + ["DEBUG"] * 2 * (100 - MAX_REPEATS)


def test_an_event_is_loud_some_times_in_five_minutes(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    """The window slides: after it, as many are loud again as are older, and the next says what was hidden."""
    events = EventLog(LOGGER, "lab")
    begin_s = clock.now_s
    for seconds in (0, 10, 20, 30, 40, 299.9, 300.0, 300.1, 310.0):
        clock.now_s = begin_s + seconds
        events.log(logging.WARNING, "renamed", "renamed")
    events.log(logging.INFO, "changed", "changed")
    hidden, loud = (
        ("DEBUG", "lab: renamed"),
        ("WARNING", "lab: renamed (1 more like this since the last one)"),
    )
    assert levels(caplog)[:MAX_REPEATS] == ["WARNING"] * 5
    assert logged(caplog)[MAX_REPEATS:] == [hidden, loud, hidden, loud, ("INFO", "lab: changed")]
    for _ in range(3):
        events.log(logging.WARNING, "late", "late", most=1)
    assert levels(caplog)[-3:] == ["WARNING", "DEBUG", "DEBUG"]


@pytest.fixture
def records() -> Iterator[list[logging.LogRecord]]:
    """Collect the records that a handler with the filter receives."""
    records: list[logging.LogRecord] = []
    handler = logging.Handler()
    handler.emit = records.append  # type: ignore[assignment, method-assign] # shorter than a class
    handler.addFilter(ContextFilter())
    LOGGER.addHandler(handler)
    yield records
    LOGGER.removeHandler(handler)


def fields(record: logging.LogRecord) -> dict[str, str]:
    return {name: getattr(record, name) for name in FIELDS if hasattr(record, name)}


def test_records_have_the_fields_that_are_set_and_no_others(records: list[logging.LogRecord]) -> None:
    """Blocks nest, and what they set ends with them."""
    LOGGER.warning("before")
    with log_fields(source="lab"):
        with log_fields(stream="3d", peer="192.0.2.20:3020"):
            LOGGER.warning("inside")
        LOGGER.warning("outside")
    LOGGER.warning("after")
    inside = {"source": "lab", "stream": "3d", "peer": "192.0.2.20:3020"}
    assert [fields(record) for record in records] == [{}, inside, {"source": "lab"}, {}]


async def test_tasks_and_callbacks_inherit_the_fields_of_the_code_that_starts_them(
    records: list[logging.LogRecord],
) -> None:
    """Two sources run in one loop, and their records must not be mixed up."""

    async def run(source: str) -> None:
        with log_fields(source=source):
            asyncio.get_running_loop().call_soon(LOGGER.warning, "callback")
            await asyncio.create_task(asyncio.sleep(0))
            LOGGER.warning("task")

    await asyncio.gather(run("hall"), run("lab"))
    found = [(fields(record)["source"], record.getMessage()) for record in records]
    assert sorted(found) == [("hall", "callback"), ("hall", "task"), ("lab", "callback"), ("lab", "task")]


def test_a_defect_is_an_error_with_its_traceback_once_for_each_place(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A defect that every frame meets is reported, and does not fill the disk."""
    defects = DefectLog(LOGGER, "lab")
    for text in ("one", "two", "3"):
        try:
            number = int(text)
            [0, 1].remove(number)
        except ValueError as defect:
            defects.log(defect)
    first, again, other = caplog.records
    assert first.levelname == other.levelname == "ERROR"
    assert names(first.message, "lab", "ValueError", "'one'")
    assert first.exc_info is not None
    assert (again.levelname, again.exc_info) == ("DEBUG", None)
    assert names(again.message, "lab", "'two'", "(again)")


def test_a_log_of_defects_can_continue_a_former_one(caplog: pytest.LogCaptureFixture) -> None:
    """After a reload of the configuration, known defects are still known."""
    former = DefectLog(LOGGER, "lab")
    logs = [former, DefectLog(LOGGER, "lab (3d)", former)]
    for defects in logs:
        try:
            int("x")
        except ValueError as defect:
            defects.log(defect)
    assert levels(caplog) == ["ERROR", "DEBUG"]
    assert [defects.count for defects in logs] == [2, 2]
