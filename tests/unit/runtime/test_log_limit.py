"""The last limit of the log: lines per minute of each source and together, and the length of lines."""

import logging
from collections.abc import Iterator

import pytest

from gateway.runtime.failures import log_fields
from gateway.runtime.log_format import (
    BURST_LINES,
    LINES_PER_MINUTE,
    MAX_LINE_LENGTH,
    OWN_BURST_LINES,
    OWN_LINES_PER_MINUTE,
    TOTAL_BURST_LINES,
    TOTAL_LINES_PER_MINUTE,
    ContextFilter,
    LogLimit,
)
from tests.support.errors import names

LOGGER = logging.getLogger("tests.log_limit")


class Lab:
    """A handler with a limit, and its clock."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.limit = LogLimit(lambda: self.now_s)
        self.lines: list[str] = []
        self._handler = logging.Handler()
        self._handler.addFilter(ContextFilter())
        self._handler.addFilter(self.limit)
        self._handler.emit = self._emit  # type: ignore[method-assign] # shorter than a class
        self._handler.setFormatter(logging.Formatter("%(levelname)s %(message)s"))

    def _emit(self, record: logging.LogRecord) -> None:
        self.lines += self._handler.format(record).split("\n")

    def __enter__(self) -> "Lab":
        logging.getLogger().addHandler(self._handler)
        return self

    def __exit__(self, *_: object) -> None:
        logging.getLogger().removeHandler(self._handler)

    def log(self, source: str, times: int, level: int = logging.INFO) -> None:
        with log_fields(source=source):
            for number in range(times):
                LOGGER.log(level, "%s: message %d", source, number)

    def lines_of(self, source: str) -> list[str]:
        return [line for line in self.lines if f"{source}: message" in line and "suppressed" not in line]


@pytest.fixture
def lab() -> Iterator[Lab]:
    level = LOGGER.level
    LOGGER.setLevel(logging.DEBUG)
    with Lab() as lab:
        yield lab
    LOGGER.setLevel(level)


def test_a_source_logs_a_burst_and_then_so_many_lines_per_minute(lab: Lab) -> None:
    lab.log("lab", 1000)
    assert len(lab.lines) == BURST_LINES
    for _ in range(10 * 60):
        lab.now_s += 0.1
        lab.log("lab", 10)
    assert len(lab.lines) == BURST_LINES + LINES_PER_MINUTE


def test_a_source_that_has_logged_little_may_log_beside_a_noisy_one(lab: Lab) -> None:
    lab.log("noisy", 1000)
    lab.log("louder", 1000)
    lab.log("lab", 5)
    assert len(lab.lines_of("lab")) == 5


def test_all_sources_together_are_limited(lab: Lab) -> None:
    for _ in range(600):
        lab.now_s += 0.1
        for source in "abcdefgh":
            lab.log(source, 5)
    own_lines = OWN_BURST_LINES + OWN_LINES_PER_MINUTE
    assert len(lab.lines) <= TOTAL_BURST_LINES + TOTAL_LINES_PER_MINUTE + 8 * own_lines
    assert min(len(lab.lines_of(source)) for source in "abcdefgh") >= OWN_BURST_LINES


def test_debug_is_not_limited(lab: Lab) -> None:
    lab.log("lab", 1000, logging.DEBUG)
    assert len(lab.lines) == 1000


def test_suppressed_messages_are_counted_a_minute_later(lab: Lab) -> None:
    lab.log("lab", BURST_LINES + 7)
    lab.now_s += 1
    lab.log("lab", 3, logging.WARNING)
    lab.now_s += 58
    lab.limit.report()
    assert "suppressed" not in lab.lines[-1]
    lab.now_s += 1
    lab.limit.report()
    lab.limit.report()
    assert lab.lines[-1].startswith("WARNING lab: 10 ")
    assert names(lab.lines[-1], "7 INFO, 3 WARNING", "lab: message 2")
    assert "suppressed" not in lab.lines[-2]


def test_messages_of_no_source_have_a_limit_of_their_own_and_can_be_reported_at_once(lab: Lab) -> None:
    for number in range(100):
        LOGGER.info("output %d", number)
    lab.log("lab", 5)
    lab.limit.report(at_once=True)
    assert len(lab.lines) == BURST_LINES + 5 + 1
    assert lab.lines[-1].startswith("WARNING gateway: 75 ")


def test_a_long_message_is_one_line_and_cut(lab: Lab) -> None:
    LOGGER.info("%s", "a\nb\x1b" * 100_000)
    [line] = lab.lines
    assert len(line) <= MAX_LINE_LENGTH + len("INFO ")
    assert line.startswith(r"INFO a\nb\x1ba")


def test_a_traceback_counts_as_its_lines_and_its_middle_is_left_out(lab: Lab) -> None:
    _log_deep_traceback(50)
    assert len(lab.lines) < 35
    assert lab.lines[0] == "ERROR deep"
    assert lab.lines[1] == "Traceback (most recent call last):"
    assert lab.lines[-1].startswith("ZeroDivisionError")
    assert any(names(line, "left out") for line in lab.lines)
    before = len(lab.lines)
    LOGGER.info("further")
    assert len(lab.lines) == before


def test_the_lines_of_a_traceback_count_for_all_sources_together(lab: Lab) -> None:
    """A defect that logs tracebacks cannot fill the log through messages that are few but long."""
    with log_fields(source="deep"):
        _log_deep_traceback(50)
    lab.log("lab", 20)
    assert len(lab.lines_of("lab")) == OWN_BURST_LINES


def test_a_traceback_uses_up_what_its_source_may_log_beside_others(lab: Lab) -> None:
    """The reserve of each source is counted in lines, too."""
    lab.log("noisy", 1000)
    lab.log("louder", 1000)
    with log_fields(source="lab"):
        _log_deep_traceback(2)
    lab.log("lab", 5)
    assert lab.lines_of("lab") == []


def _log_deep_traceback(depth: int) -> None:
    def step(left: int) -> float:
        return 1 / left * other_step(left - 1)

    def other_step(left: int) -> float:
        return 1 / left * step(left - 1)

    try:
        step(depth)
    except ZeroDivisionError:
        LOGGER.exception("deep")
