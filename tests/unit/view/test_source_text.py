"""What the panel says about a source."""

import re

import pytest
import rtc3d

from gateway.live.component import LiveComponent
from gateway.live.latency import Percentiles
from gateway.messages.host_time import now_utime
from gateway.rtc3d.components import ComponentType
from gateway.view.source_text import ignored_html, source_html
from tests.statuses import loss, output, stream
from tests.unit.view.live_lab import Lab

HOSTILE = "<img src=x onerror=alert(1)>"


def text_of(html: str) -> str:
    """Return the text of a page, with | between cells and lines."""
    return re.sub(r"\s*(<[^>]*>\s*)+", "|", html)


def shown_text(lab: Lab, *, is_take: bool = False) -> str:
    return text_of(source_html(lab.source, {"3d": Percentiles(16, 33)}, is_take=is_take))


@pytest.fixture
def lab() -> Lab:
    return Lab()


def test_state_server_and_gateway(lab: Lab) -> None:
    lab.send_status(stream())
    text = shown_text(lab)
    assert "|lab|streaming 200.0 Hz|server 192.0.2.9:3020 · gateway 1.2.3 on gatewaypc|" in text


def test_rates_and_announced_rates(lab: Lab) -> None:
    lab.send_parameters("<The_3D><Markers>2</Markers><Frequency>200</Frequency></The_3D>")
    lab.send_markers(True, True)
    assert "|3d|2|0.0|of 200.0|1|0|" in shown_text(lab)
    assert "<span class=waiting>0.0</span>" in source_html(lab.source, {}, is_take=False)
    assert "waiting" not in source_html(lab.source, {}, is_take=True)


def test_latency_by_stage(lab: Lab) -> None:
    lab.send_markers(True)
    cells = re.search(r"3d\|([^|]*)\|([^|]*)\|([^|]*)\|", shown_text(lab).split("captured → gateway")[1])
    assert cells is not None
    assert cells[1] == "2.00 / 2.00"
    assert re.fullmatch(r"\d.* / \d.*", cells[2])
    assert cells[3] == "16.0 / 33.0"


def test_a_take_has_no_latency_to_here(lab: Lab) -> None:
    lab.send(ComponentType.MARKERS, [(1, 2, 3, 4)], utime=1_700_000_000_000_000)
    text = shown_text(lab, is_take=True)
    assert "2.00 / 2.00" in text
    assert "here" not in text
    assert "clock" not in text


@pytest.mark.parametrize(
    ("delay_us", "sentence"),
    [
        (90_000_000, "Messages seem to take 1 min 30 s from the gateway to here."),
        (-3_000_000, "clock is at least 3.0 s behind that of the gateway"),
    ],
)
def test_clocks_of_two_computers_that_differ(lab: Lab, delay_us: int, sentence: str) -> None:
    lab.send(ComponentType.MARKERS, [(1, 2, 3, 4)], utime=now_utime() - delay_us)
    assert sentence in shown_text(lab)


def test_clocks_that_agree_are_not_mentioned(lab: Lab) -> None:
    lab.send_markers(True)
    assert "clock" not in shown_text(lab)


def test_nothing_lost(lab: Lab) -> None:
    lab.send_markers(True)
    lab.send_status(stream())
    assert "nothing lost, dropped or skipped" in shown_text(lab)


def test_messages_that_are_lost_on_the_way(lab: Lab) -> None:
    for sequence in (0, 5, 6, 8, 0):
        lab.send(ComponentType.MARKERS, [(1, 2, 3, 4)], sequence=sequence)
    text = shown_text(lab)
    assert "3d: 5 messages lost in 2 gaps" in text
    assert "3d: numbers restarted 1 time" in text
    assert "nothing lost" not in text


def test_drops_by_cause_of_streams_and_outputs(lab: Lab) -> None:
    lab.send_status(
        stream("3d 6d", drops=[loss("skipped while behind", 12, 6)]),
        outputs=[
            output("zenoh", drops=[loss("queue full", 3, 3), loss("closed", 1, 0)]),
            output("lcm", connected=False, problem="no route to 239.255.76.67"),
        ],
    )
    text = shown_text(lab)
    assert "dropped at 3d 6d: 12 messages of 6 frames (skipped while behind)" in text
    assert "dropped at output zenoh: 3 messages of 3 frames (queue full), 1 message (closed)" in text
    assert "output lcm: no route to 239.255.76.67" in text


def test_limitations_and_the_last_error(lab: Lab) -> None:
    lab.send_status(
        stream(
            "3d",
            limitations=["the server refused ByteOrder"],
            last_error="connection refused",
            last_error_utime=1_700_000_000_000_000,
        )
    )
    text = shown_text(lab)
    assert "3d: the server refused ByteOrder" in text
    assert re.search(r"last error of 3d, \d\d:\d\d:20: connection refused", text)


def test_nothing_of_a_gateway_is_html() -> None:
    lab = Lab()
    lab.send_status(
        stream(
            HOSTILE,
            HOSTILE,
            problem=HOSTILE,
            limitations=[HOSTILE],
            last_error=HOSTILE,
            drops=[loss(HOSTILE, 1, 1)],
        ),
        server=HOSTILE,
        host=HOSTILE,
        gateway_version=HOSTILE,
        outputs=[output(HOSTILE, connected=False, problem=HOSTILE, drops=[loss(HOSTILE, 1, 1)])],
    )
    html = source_html(lab.source, {}, is_take=False)
    assert "<img" not in html
    assert html.count("&lt;img") == 14


def test_a_status_of_any_size_is_cut() -> None:
    lab = Lab()
    many = [stream("3d" * 1000, limitations=["x" * 1000] * 50, drops=[loss("y" * 1000, 1, 1)] * 50)] * 500
    lab.send_status(*many, outputs=[output("z" * 1000, connected=False, problem="p" * 1000)] * 500)
    assert len(source_html(lab.source, {}, is_take=False)) < 300_000


def test_what_belongs_to_no_source() -> None:
    lab = Lab()
    assert ignored_html(lab.live) == ""
    lab.live.ignore(beyond_limit=False)
    lab.live.ignore(beyond_limit=True)
    text = ignored_html(lab.live)
    assert "left out: 1 message of another program, 1 message of more sources or keys" in text


def test_parameters_and_status_that_cannot_be_read() -> None:
    lab = Lab()
    broken = rtc3d.status_t().encode()[:60]
    lab.live.publish("lab", "status", broken)
    assert "parameters or status that cannot be read: 1 message" in shown_text(lab)


def test_a_component_that_a_thread_adds_at_this_moment(lab: Lab) -> None:
    lab.send_markers(True)
    source = lab.source
    source.components["analog"] = LiveComponent(ComponentType.ANALOG)
    assert "analog" not in source_html(source, {}, is_take=False)
