"""Counting what is lost by cause, in total and in the last minute, and logging it without filling the log."""

import logging

import pytest

from gateway.runtime.failures import HOLD_S, MAX_HOLD_S
from gateway.runtime.losses import Losses, counts_text, last_minute_text
from tests.support.clocks import Clock
from tests.support.errors import each_names
from tests.support.statuses import amounts

LOGGER = logging.getLogger("tests.losses")


@pytest.fixture
def losses(clock: Clock, caplog: pytest.LogCaptureFixture) -> Losses:
    caplog.set_level(logging.DEBUG, LOGGER.name)
    return Losses(LOGGER, "lab", clock)


def logged(caplog: pytest.LogCaptureFixture) -> list[str]:
    lines = [f"{record.levelname} {record.getMessage()}" for record in caplog.records]
    caplog.clear()
    return lines


def test_streams_of_one_source_warn_together_of_one_cause(
    clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    """A busy computer makes all streams lose frames; one line says so, and the sums stay separate."""
    shared: dict[str, float] = {}
    first, second = (Losses(LOGGER, name, clock, shared) for name in ("lab (3d)", "lab (analog)"))
    with caplog.at_level(logging.INFO):
        first.lost("skipped", "frames are late")
        clock.now_s += 1
        second.lost("skipped", "frames are late")
        assert caplog.messages == ["lab (3d): frames are late"]
        clock.now_s += 60
        first.check()
        second.check()
    assert [message.partition(":")[0] for message in caplog.messages[1:]] == ["lab (3d)", "lab (analog)"]


def test_messages_and_frames_are_counted_by_cause(losses: Losses) -> None:
    losses.lost("skipped", "late", messages=2)
    losses.lost("skipped", "late", messages=3)
    losses.lost("file", "disk full", frames=0)
    assert amounts(losses.report()) == {"skipped": (5, 2), "file": (1, 0)}
    assert losses.frames("skipped") == 2
    assert losses.frames("unheard of") == 0


def test_a_frame_counts_once_for_each_cause_however_many_messages_it_loses(losses: Losses) -> None:
    first, second = object(), object()
    for frame in (first, first, second, None):
        losses.message_lost("no router", "start it", frame)
    losses.message_lost("put failed", "report it", second)
    assert amounts(losses.report()) == {"no router": (4, 2), "put failed": (1, 1)}


def test_the_last_minute_forgets_what_is_older_and_the_total_does_not(losses: Losses, clock: Clock) -> None:
    losses.lost("skipped", "late", messages=2)
    clock.now_s += 30
    losses.lost("skipped", "later", messages=3)
    for expected in ((5, 2, 0.0), (3, 1, 30.0), (0, 0, 60.0)):
        [loss] = losses.report()
        assert (loss.messages_last_minute, loss.frames_last_minute, loss.age_s) == expected
        clock.now_s += 30
    [loss] = losses.report()
    assert (loss.messages, loss.frames, loss.text) == (5, 2, "later")


def test_the_last_minute_is_complete_if_something_is_lost_all_the_time(losses: Losses, clock: Clock) -> None:
    for _ in range(200 * 10):
        losses.lost("skipped", "late")
        clock.now_s += 0.1
    [loss] = losses.report()
    assert loss.messages == 2000
    assert loss.messages_last_minute == pytest.approx(600, abs=10)


def test_loss_is_logged_when_it_begins_and_with_the_total_when_it_ends(
    losses: Losses, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(250):
        losses.lost("no router", "start zenohd", messages=5)
        losses.check()
        clock.now_s += 0.01
    assert logged(caplog) == ["WARNING lab: start zenohd"]
    clock.now_s += HOLD_S - 0.1
    losses.check()
    assert logged(caplog) == []
    clock.now_s += 0.1
    losses.check()
    losses.check()
    assert logged(caplog) == [
        "INFO lab: lost within 2.5 s: 1250 messages of 250 frames (no router); no more in the 5 s since then"
    ]


def test_the_next_period_has_a_total_of_its_own(
    losses: Losses, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    """Also one that begins while nobody has checked for the end of the former one."""
    for number in (1, 2):
        for _ in range(number):
            losses.lost("no router", "start zenohd", frames=0)
        clock.now_s += 100
        if number == 1:
            losses.check()
    losses.lost("no router", "start zenohd", frames=0)
    begin = ["WARNING lab", "start zenohd"]
    first, second = (["INFO lab", "0.0 s", counts_text([("no router", number, 0)])] for number in (1, 2))
    assert each_names(logged(caplog), begin, first, begin, second, begin)
    assert amounts(losses.report()) == {"no router": (4, 0)}


def test_causes_that_alternate_are_logged_once_each(
    losses: Losses, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(1000):
        losses.lost("no router", "start zenohd")
        losses.lost("put failed", "report it", messages=2, frames=2, level=logging.ERROR)
        clock.now_s += 1
        losses.check()
    assert logged(caplog) == ["WARNING lab: start zenohd", "ERROR lab: report it"]
    losses.close()
    lost = counts_text([("no router", 1000, 1000), ("put failed", 2000, 2000)])
    assert each_names(logged(caplog), ["INFO lab", "999.0 s", lost])
    losses.close()
    assert logged(caplog) == []


def test_a_loss_that_is_expected_at_first_is_logged_again_as_warning(
    losses: Losses, caplog: pytest.LogCaptureFixture
) -> None:
    for level in (logging.INFO, logging.INFO, logging.WARNING, logging.INFO, logging.WARNING):
        losses.message_lost("not open", "it opens", None, level=level)
    assert logged(caplog) == ["INFO lab: it opens", "WARNING lab: it opens"]


@pytest.mark.parametrize("period_s", [6.0, 20.0, 59.0])
def test_loss_that_comes_and_goes_does_not_fill_the_log(
    losses: Losses, clock: Clock, caplog: pytest.LogCaptureFixture, period_s: float
) -> None:
    for _ in range(1000):
        losses.lost("no router", "start zenohd")
        for _ in range(int(period_s)):
            clock.now_s += 1
            losses.check()
    assert len(logged(caplog)) < 12
    clock.now_s += MAX_HOLD_S
    losses.check()
    assert amounts(losses.report()) == {"no router": (1000, 1000)}
    clock.now_s += MAX_HOLD_S
    logged(caplog)
    losses.lost("no router", "start zenohd")
    clock.now_s += HOLD_S
    losses.check()
    assert len(logged(caplog)) == 2  # after a long pause, the wait is short again


def test_texts_say_how_much_and_why(losses: Losses, clock: Clock) -> None:
    assert last_minute_text(losses.report()) == ""
    losses.lost("skipped while behind", "late", messages=872, frames=436)
    losses.lost("C3D file", "disk full", frames=0)
    amount = "1 message (C3D file), 872 messages of 436 frames (skipped while behind)"
    assert last_minute_text(losses.report()).endswith(f": {amount}")
    clock.now_s += 90
    assert last_minute_text(losses.report()) == ""
