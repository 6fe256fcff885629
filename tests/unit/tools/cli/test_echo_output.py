"""What ``echo`` prints; tests/integration/commands/test_params_command.py runs the command."""

import io
import json
from contextlib import nullcontext

import pytest
import rtc3d

from gateway.outputs.kind import Receive, SubscriptionRequest
from gateway.tools.cli import echo_output
from gateway.tools.cli.echo_output import (
    MAX_KEYS,
    MAX_WAITING,
    MIN_WINDOW,
    Rate,
    Rates,
    print_messages,
    print_rates,
)
from gateway.tools.cli.echo_sources import EchoSources
from tests.support.clocks import Clock
from tests.support.errors import names
from tests.support.parameters import in_root, spec_xml

MARKERS_BYTES = len(spec_xml("3d"))


SOURCES = EchoSources("example", SubscriptionRequest())


class Published:
    """A subscription that has received these messages at once."""

    def __init__(self, *messages: tuple[str, bytes]) -> None:
        self._messages = messages

    def __call__(self, receive: Receive) -> "Published":
        for name, message in self._messages:
            receive(name, message)
        return self

    def close(self) -> None:
        """Do nothing."""


def printed(name: str, message: bytes, *, as_json: bool = False) -> str:
    out = io.StringIO()
    published = Published((name, message))
    assert print_messages(published, SOURCES, out, count=1, seconds=10, as_json=as_json) == 1
    return out.getvalue().removesuffix("\n")


def parameters() -> bytes:
    message = rtc3d.parameters_t()
    message.sequence, message.session, message.xml = 4, 2, spec_xml("3d").decode()
    message.parameters_version = 3
    return bytes(message.encode())


def request() -> bytes:
    message = rtc3d.parameters_request_t()
    message.request_id, message.requester, message.fresh = 7, "viewer", True
    message.sections, message.num_sections = ["3d", "6d"], 2
    return bytes(message.encode())


def reply(error: str = "") -> bytes:
    message = rtc3d.parameters_reply_t()
    message.request_id, message.requester, message.age_s, message.error = 7, "viewer", 1.25, error
    message.xml = "" if error else in_root("<General/>").decode()
    return bytes(message.encode())


NO_ITEMS = in_root("<The_6D/>", "<Analog/>", "<Force/>", "<Events/>")
FILE = b'{"name":"lab-1.c3d","bytes":123}'
PARAMETERS = "MOCAP_LAB_PARAMETERS"


@pytest.mark.parametrize(
    ("name", "message", "text"),
    [
        ("mocap/lab/parameters", spec_xml("3d"), f"{MARKERS_BYTES} bytes of XML: 1 marker"),
        ("m", NO_ITEMS, "82 bytes of XML: 0 tools, 0 analog channels, 0 force plates, 0 events"),
        ("mocap/lab/parameters", b"<!-- -->", "8 bytes of XML that"),
        ("mocap/lab/c3d", FILE, "name lab-1.c3d, bytes 123"),
        (PARAMETERS, parameters(), f"#4 session 2, version 3: {MARKERS_BYTES} bytes of XML: 1 marker"),
        (f"{PARAMETERS}_REQUEST", request(), "request 7 from 'viewer': 3d 6d, fresh"),
        (
            f"{PARAMETERS}_REPLY",
            reply(),
            "reply 7 to 'viewer': 54 bytes of XML: no markers",
        ),
        (f"{PARAMETERS}_REPLY", reply("it is \x1b[31maway"), "reply 7 to 'viewer': it is \\x1b[31maway"),
    ],
    ids=range(8),
)
def test_a_line_summarises_a_message(name: str, message: bytes, text: str) -> None:
    assert printed(name, message).startswith(f"{name} {text}")


@pytest.mark.parametrize(
    "message", [b"", b"12345678 of something else", b"[1]", b"[" * 100_000, b"{", b"\xff{"]
)
def test_a_message_of_another_program_is_printed_as_an_error(message: bytes) -> None:
    error = json.loads(printed("mocap/lab/parameters", message, as_json=True))["error"]
    assert names(error, f"{len(message)} bytes")
    assert error in printed("mocap/lab/parameters", message)


def test_json_has_xml_as_text_and_the_fields_of_other_messages() -> None:
    value = json.loads(printed("mocap/lab/parameters", spec_xml("force"), as_json=True))
    assert value == {"key": "mocap/lab/parameters", "xml": spec_xml("force").decode()}
    value = json.loads(printed("mocap/lab/c3d", FILE, as_json=True))
    assert value == {"key": "mocap/lab/c3d", "name": "lab-1.c3d", "bytes": 123}
    value = json.loads(printed("MOCAP_LAB_PARAMETERS_REQUEST", request(), as_json=True))
    assert (value["request_id"], value["requester"], value["sections"]) == (7, "viewer", ["3d", "6d"])


class Interrupted(io.StringIO):
    def write(self, _text: str) -> int:
        raise KeyboardInterrupt


@pytest.mark.parametrize("is_interrupted", [False, True])
def test_messages_that_come_faster_than_they_are_printed_are_counted(
    is_interrupted: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    printed("mocap/lab/c3d", b'{"n": 1}')
    assert capsys.readouterr().err == ""
    published = Published(*[("mocap/lab/c3d", b'{"n": 1}')] * (MAX_WAITING + 5))
    out = Interrupted() if is_interrupted else io.StringIO()
    with pytest.raises(KeyboardInterrupt) if is_interrupted else nullcontext():
        assert print_messages(published, SOURCES, out, count=7, seconds=10, as_json=False) == 7
        assert out.getvalue().count("\n") == 7
    assert capsys.readouterr().err.startswith("5 messages were not printed, because they came faster than")


# --- the rates of ``echo --hz``


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
    lines = printed_rates(messages).splitlines()
    assert len([line for line in lines if line.startswith("mocap")]) == MAX_KEYS
    assert "3 messages are in no row, because there are more than 1000 keys" in capsys.readouterr().err


def printed_rates(messages: list[tuple[str, bytes]], *, as_json: bool = False) -> str:
    out = io.StringIO()
    count = len(messages)
    assert print_rates(Published(*messages), SOURCES, out, count=count, seconds=10, as_json=as_json) == count
    return out.getvalue()


def test_without_a_terminal_there_is_a_line_for_each_key() -> None:
    lines = printed_rates([("mocap/lab/6d", b""), ("mocap/lab/3d", b""), ("mocap/lab/3d", b"")]).splitlines()
    assert [line.split("\t")[0] for line in lines] == ["mocap/lab/3d", "mocap/lab/6d"]
    assert lines[1].split("\t")[1:] == ["-", "-", "-", "-", "1"]


def test_json_has_an_object_for_each_key_and_hostile_keys_are_escaped() -> None:
    text = printed_rates([("a", b""), ("b\x1b[2J\n", b"")], as_json=True)
    rows = [json.loads(line) for line in text.splitlines()]
    assert [row["key"] for row in rows] == ["a", "b\x1b[2J\n"]
    fields = {"utime", "key", "rate_hz", "min_s", "max_s", "std_dev_s", "window", "age_s", "has_stopped"}
    assert rows[0].keys() == fields
    assert rows[0]["utime"] == rows[1]["utime"]
    assert "\x1b" not in text + printed_rates([("\x1b[2J\n", b"")])


def test_a_block_is_printed_every_second_until_the_time_is_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(echo_output, "_EACH_S", 0.05)
    out = io.StringIO()
    assert print_rates(Published(("a", b"")), SOURCES, out, count=None, seconds=0.5, as_json=False) == 1
    assert out.getvalue().count("a\t") >= 2
