"""The clocks of the host: the offset between them, steps and slow corrections."""

import logging
import time
from collections.abc import Callable
from itertools import count

import pytest

from gateway.messages.host_time import HostClock, now_steady_us, now_utime

DAY_S = 86_400.0


@pytest.fixture
def set_clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Set the wall clock, by a number of seconds. Both clocks advance by 1 µs with each reading."""
    readings_ns = count(5_000_000_000_000, 1000)
    offset_ns = time.time_ns()

    def set_clock(by_s: float) -> None:
        nonlocal offset_ns
        offset_ns += round(1e9 * by_s)

    monkeypatch.setattr(time, "clock_gettime_ns", lambda _: next(readings_ns))
    monkeypatch.setattr(time, "time_ns", lambda: next(readings_ns) + offset_ns)
    return set_clock


def test_a_reading_has_both_clocks_and_utime_is_in_microseconds_since_the_epoch() -> None:
    clock = HostClock()
    before_ns, before_us = time.time_ns(), now_steady_us()
    utime, steady_us = clock.read()
    assert before_us <= steady_us <= now_steady_us()
    assert before_ns // 1000 - 1000 <= utime <= now_utime() + 1000
    assert now_utime() <= time.time_ns() // 1000


@pytest.mark.interpreted
def test_the_offset_is_that_of_the_reading_interrupted_least(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process may be stopped between the two clocks; such a reading would look like a step."""
    delays_us = iter([500, 40_000, 2, 900, 70])
    now_us = 1_000_000

    def wall() -> int:
        nonlocal now_us
        now_us += next(delays_us)
        return 5_000_000_000 + now_us

    monkeypatch.setattr("gateway.messages.host_time.now_steady_us", lambda: now_us)
    monkeypatch.setattr("gateway.messages.host_time.now_utime", wall)
    assert HostClock().offset_us == 5_000_000_002


def test_the_clocks_do_not_drift_apart_while_nobody_sets_the_wall_clock() -> None:
    clock = HostClock()
    offsets_us = {utime - steady_us for utime, steady_us in (clock.read() for _ in range(10_000))}
    # One value; another one if the process was interrupted during the first measurement.
    assert len(offsets_us) <= 2
    assert clock.steps == 0


@pytest.mark.parametrize(
    ("by_s", "text"),
    [
        *((0.5, "forward by 0.500"), (-0.5, "back by 0.500"), (-DAY_S, "back by 86400.000")),
        (200 * DAY_S, "forward by 17280000.000"),
    ],
)
def test_a_step_is_followed_at_once_and_logged_once(
    by_s: float, text: str, set_clock: Callable[[float], None], caplog: pytest.LogCaptureFixture
) -> None:
    clock = HostClock()
    utime, steady_us = clock.read()
    set_clock(by_s)
    for _ in range(100):
        utime_after, steady_after_us = clock.read()
        assert utime_after - steady_after_us == pytest.approx(utime - steady_us + 1e6 * by_s, abs=5)
        assert 0 <= steady_after_us - steady_us < 10_000_000
    assert clock.steps == 1
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    [message] = caplog.messages
    assert text[:-2] in message


def test_slow_corrections_are_followed_in_silence(
    set_clock: Callable[[float], None], caplog: pytest.LogCaptureFixture
) -> None:
    clock = HostClock()
    before_us = clock.offset_us
    for _ in range(1000):
        set_clock(0.0005)
        clock.read()
    assert clock.offset_us - before_us == pytest.approx(500_000, abs=5)
    assert (clock.steps, caplog.messages) == (0, [])


def test_the_log_of_a_clock_that_is_set_all_the_time_is_bounded(
    set_clock: Callable[[float], None], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "gateway.messages.host_time")
    clock = HostClock()
    for _ in range(25):
        set_clock(1.0)
        clock.read()
    assert clock.steps == 25
    assert [record.levelname for record in caplog.records] == 10 * ["WARNING"] + 15 * ["DEBUG"]
