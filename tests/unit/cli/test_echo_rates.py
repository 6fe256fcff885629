"""The rates of ``echo --hz``: their figures, and how they are printed."""

import io
import json

import pytest

from gateway.cli import echo_rates
from gateway.cli.echo_messages import Limits
from gateway.cli.echo_rates import MAX_KEYS, MIN_WINDOW, Rate, Rates, print_rates
from gateway.cli.echo_sources import Silence
from tests.settable_clock import Clock
from tests.unit.cli.test_echo import REQUEST, Published


def receive(rates: Rates, clock: Clock, intervals_s: list[float], key: str = "mocap/lab/3d") -> Rate:
    """Receive a message after each interval; return the rate of their key."""
    for interval_s in intervals_s:
        clock.now_s += interval_s
        rates.receive(key, b"")
    [row] = [row for row in rates.rows() if row.key == key]
    return row


def test_figures_are_those_of_the_intervals(clock: Clock) -> None:
    row = receive(Rates(monotonic=clock), clock, [5.0, *([0.01, 0.03] * 100)])
    assert row.rate_hz == pytest.approx(50)
    assert (row.min_s, row.max_s, row.std_dev_s) == pytest.approx((0.01, 0.03, 0.01))
    assert (row.window, row.age_s, row.has_stopped) == (201, 0, False)


def test_the_window_is_ten_seconds_and_at_least_ten_messages(clock: Clock) -> None:
    rates = Rates(monotonic=clock)
    assert receive(rates, clock, [0.01] * 5000).window == pytest.approx(1001, abs=1)
    assert receive(rates, clock, [7.0] * 50, "slow").window == MIN_WINDOW
    assert [row.rate_hz for row in rates.rows() if row.key == "slow"] == [pytest.approx(1 / 7)]


def test_a_key_that_stops_has_the_rate_0(clock: Clock) -> None:
    rates = Rates(monotonic=clock)
    receive(rates, clock, [0.01] * 100)
    receive(rates, clock, [1.0] * 3, "status")
    clock.now_s += 2.5
    stopped, running = rates.rows()
    assert (stopped.rate_hz, stopped.has_stopped) == (0, True)
    assert stopped.age_s == pytest.approx(5.5)
    assert not running.has_stopped


def test_a_few_messages_at_once_are_no_high_rate(clock: Clock) -> None:
    rates = Rates(monotonic=clock)
    receive(rates, clock, [0, 0.00001])
    clock.now_s += 1
    [row] = rates.rows()
    assert row.rate_hz == pytest.approx(1, rel=0.01)
    assert receive(rates, clock, [0], "once")[1:6] == (0, None, None, None, 1)


def test_messages_after_the_last_one_wanted_do_not_count(clock: Clock) -> None:
    rates = Rates(3, monotonic=clock)
    assert receive(rates, clock, [1] * 10).window == 3
    assert rates.num_messages == 3
    assert rates.is_complete.is_set()


def test_the_number_of_keys_is_bounded_and_said(capsys: pytest.CaptureFixture[str]) -> None:
    messages = [(f"mocap/lab/6d/{number}", b"") for number in range(MAX_KEYS + 3)]
    lines = printed(messages).splitlines()
    assert len([line for line in lines if line.startswith("mocap")]) == MAX_KEYS
    assert "3 messages are in no row, because there are more than 1000 keys" in capsys.readouterr().err


def printed(messages: list[tuple[str, bytes]], *, as_json: bool = False) -> str:
    out = io.StringIO()
    limits, silence = Limits(len(messages), 10), Silence("example", REQUEST)
    num_messages = print_rates(Published(*messages), REQUEST, limits, silence, out, as_json=as_json)
    assert num_messages == len(messages)
    return out.getvalue()


def test_without_a_terminal_there_is_a_line_for_each_key() -> None:
    lines = printed([("mocap/lab/6d", b""), ("mocap/lab/3d", b""), ("mocap/lab/3d", b"")]).splitlines()
    assert [line.split("\t")[0] for line in lines] == ["mocap/lab/3d", "mocap/lab/6d"]
    assert lines[1].split("\t")[1:] == ["-", "-", "-", "-", "1"]


def test_json_has_an_object_for_each_key_and_hostile_keys_are_escaped() -> None:
    text = printed([("a", b""), ("b\x1b[2J\n", b"")], as_json=True)
    rows = [json.loads(line) for line in text.splitlines()]
    assert [row["key"] for row in rows] == ["a", "b\x1b[2J\n"]
    fields = {"utime", "key", "rate_hz", "min_s", "max_s", "std_dev_s", "window", "age_s", "has_stopped"}
    assert rows[0].keys() == fields
    assert rows[0]["utime"] == rows[1]["utime"]
    assert "\x1b" not in text + printed([("\x1b[2J\n", b"")])


def test_a_block_is_printed_every_second_until_the_time_is_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(echo_rates, "_EACH_S", 0.05)
    out = io.StringIO()
    silence = Silence("example", REQUEST)
    assert print_rates(Published(("a", b"")), REQUEST, Limits(None, 0.5), silence, out, as_json=False) == 1
    assert out.getvalue().count("a\t") >= 2
