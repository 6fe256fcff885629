"""What the panel says about sources: whether the picture is live, their state and their losses."""

import re
import time
from typing import Any

import pytest
import rtc3d

from gateway.messages.host_time import now_utime
from gateway.messages.source_report import Level, State
from gateway.rtc3d.components import ComponentType
from gateway.runtime.losses import counts_text
from gateway.tools.display.live import DisplayedSource, LiveComponent
from gateway.tools.display.view.panel import MAX_SHOWN_SOURCES, banner_html
from gateway.tools.display.view.texts import clock_text, data_state, gateway_states, ignored_html, source_html
from tests.support.errors import names
from tests.support.statuses import loss, output, stream
from tests.unit.tools.display.live_lab import Lab, text_of, wait

HOSTILE = "<img src=x onerror=alert(1)>"


def shown_text(lab: Lab, *, is_take: bool = False) -> str:
    return text_of(source_html(lab.source, is_take=is_take))


def test_state_server_rates_and_latency_by_stage(lab: Lab) -> None:
    lab.send_status(stream())
    lab.send_parameters("<The_3D><Markers>2</Markers><Frequency>200</Frequency></The_3D>")
    lab.send_markers(True, True)
    lab.source.components["3d"].latency.shown_ms.extend((16.0, 16.0))
    text = shown_text(lab)
    assert "|lab|streaming 200.0 Hz|server 192.0.2.9:3020 · gateway 1.2.3 on gatewaypc|" in text
    assert "|3d|2|0|of 200|1|" in text
    assert re.search(r"captured → gateway.*3d\|2.00 / 2.00\|\d[^|]* / \d[^|]*\|16.0 / 16.0\|", text)
    assert "nothing lost, dropped or skipped" in text
    assert "clock" not in text
    assert "<span class=waiting>0</span>" in source_html(lab.source, is_take=False)
    assert "waiting" not in source_html(lab.source, is_take=True)


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


def test_messages_that_are_lost_on_the_way(lab: Lab) -> None:
    for sequence in (0, 5, 6, 8, 0):
        lab.send(ComponentType.MARKERS, [(1, 2, 3, 4)], sequence=sequence)
    text = shown_text(lab)
    assert "|lost messages|server|gateway|here|all|3d|0|0|5|5|" in text
    assert "3d: 2 gaps in the numbers of the messages" in text
    assert "3d: numbers restarted 1 time" in text
    assert "nothing lost" not in text
    assert "<p class=bad>3d: 2 gaps" in source_html(lab.source, is_take=False)


def test_drops_by_cause_of_streams_and_outputs(lab: Lab) -> None:
    zenoh = output("zenoh", drops=[loss("queue full", 3, 3), loss("closed", 1, 0)])
    lcm = output("lcm", connected=False, problem="no route to 239.255.76.67")
    limited = stream("3d", limitations=["the server refused ByteOrder"], last_error="connection refused")
    limited.last_error_utime = 1_700_000_000_000_000
    skipped = stream("3d 6d", drops=[loss("skipped while behind", 12, 6)])
    lab.send_status(skipped, limited, outputs=[zenoh, lcm])
    text = shown_text(lab)
    assert f"dropped at 3d 6d: {counts_text([('skipped while behind', 12, 6)])}" in text
    assert f"dropped at output zenoh: {counts_text([('queue full', 3, 3), ('closed', 1, 0)])}" in text
    assert "output lcm: no route to 239.255.76.67" in text
    assert "3d: the server refused ByteOrder" in text
    assert re.search(r"last error of 3d, \d\d:\d\d:20: connection refused", text)


def test_losses_have_one_figure_for_each_component_and_place(lab: Lab) -> None:
    """What the gateway skips while the view runs is a gap in the numbers, too, but is not lost twice."""

    def send(num_unsent: int, num_skipped: int, sequence: int) -> None:
        drops = [
            loss("not sent by the server", 2 * num_unsent, num_unsent),
            loss("skipped while behind", 2 * num_skipped, num_skipped),
            loss("C3D file", 1, 0),
        ]
        lab.send_status(stream("3d 6d event", drops=drops), sequence=sequence)
        assert lab.source

    send(400, 90, sequence=0)
    lab.send_markers(True)
    lab.send(ComponentType.TOOLS, [(1, 0, 0, 0, 0, 0, 0, 0)])
    lab.send(ComponentType.EVENT, [(1, 2, 3, 4, 5)])
    send(400, 91, sequence=1)
    lab.send(ComponentType.MARKERS, [(1, 2, 3, 4)], sequence=4)  # one skipped, two lost on the way
    lab.send(ComponentType.TOOLS, [(1, 0, 0, 0, 0, 0, 0, 0)], sequence=2)
    text = shown_text(lab)
    assert "|here|all|3d|400|91|2|493|6d|400|91|0|491|event|0|0|0|0|Server and gateway: since" in text


def test_a_take_that_is_recorded_is_in_the_banner_with_its_source(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.send_status(stream())
    lab.send_markers(True)
    source = lab.source
    assert "record" not in shown_text(lab) + banner_html([source], NOW_S)
    source.running_take = ""
    assert "|recording no take|" in shown_text(lab)
    assert "record" not in banner_html([source], NOW_S)
    source.running_take = HOSTILE
    assert "● recording|&lt;img" in text_of(banner_html([source], NOW_S))
    wait(monkeypatch, 5)
    assert "record" not in banner_html([source], NOW_S)  # the gateway is not heard any more


def test_what_an_output_drops_is_beside_the_components(lab: Lab) -> None:
    lab.send_status(stream(), outputs=[output("zenoh", drops=[loss("not open", 982, 196)]), output("lcm")])
    text = shown_text(lab)
    assert "|here|all|output zenoh|–|982|–|982|Server" in text
    assert "output lcm" not in text


def test_nothing_of_a_gateway_is_html(lab: Lab) -> None:
    evil: dict[str, Any] = {"problem": HOSTILE, "drops": [loss(HOSTILE, 1, 1)]}
    streams = stream(HOSTILE, HOSTILE, limitations=[HOSTILE], last_error=HOSTILE, **evil)
    names = dict.fromkeys(("server", "host", "gateway_version"), HOSTILE)
    lab.send_status(streams, outputs=[output(HOSTILE, connected=False, **evil)], **names)
    html = source_html(lab.source, is_take=False)
    assert "<img" not in html
    assert html.count("&lt;img") == 15


def test_a_status_of_any_size_is_cut() -> None:
    lab = Lab()
    many = [stream("3d" * 1000, limitations=["x" * 1000] * 50, drops=[loss("y" * 1000, 1, 1)] * 50)] * 500
    lab.send_status(*many, outputs=[output("z" * 1000, connected=False, problem="p" * 1000)] * 500)
    assert len(source_html(lab.source, is_take=False)) < 400_000


def test_what_belongs_to_no_source_or_cannot_be_read(lab: Lab) -> None:
    assert ignored_html(lab.live) == ""
    lab.live.ignore(beyond_limit=False)
    lab.live.ignore(beyond_limit=True)
    text = ignored_html(lab.live)
    assert "left out: 1 message of another program, 1 message of more sources or keys" in text
    lab.live.publish("lab", "status", rtc3d.status_t().encode()[:60])
    assert "parameters or status that cannot be read: 1 message" in shown_text(lab)


def test_a_component_that_a_thread_adds_at_this_moment(lab: Lab) -> None:
    lab.send_markers(True)
    source = lab.source
    source.components["analog"] = LiveComponent(ComponentType.ANALOG)
    assert "analog" not in source_html(source, is_take=False)


def test_data_before_the_first_and_while_they_come(lab: Lab) -> None:
    lab.send_status()
    assert data_state(lab.source) == State(Level.WAITING, "no data yet")
    lab.send_markers(True)
    assert data_state(lab.source) == State(Level.GOOD, "live")


def test_data_that_have_stopped(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.send_markers(True)
    lab.send(ComponentType.EVENT, [(1, 2, 3, 4, 5)])
    source = lab.source
    wait(monkeypatch, 12)
    assert data_state(source) == State(Level.BAD, "no data for 12 s")


def test_components_of_which_nothing_has_come_yet(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    """The history has some; until it answers, an event does not make a source live that has ended."""
    lab.send(ComponentType.EVENT, [(1, 2, 3, 4, 5)])
    source = lab.source
    source.components["3d"] = LiveComponent(ComponentType.MARKERS)
    assert data_state(source).level is Level.WAITING
    lab.send(ComponentType.ANALOG, [1.5])
    source = lab.source
    wait(monkeypatch, 12)
    level, text = data_state(source)
    assert (level, names(text, "12 s")) == (Level.BAD, True)


def test_one_component_that_has_stopped(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.send(ComponentType.ANALOG, [1.5])
    assert lab.source
    wait(monkeypatch, 3)
    lab.send_markers(True)
    assert data_state(lab.source) == State(Level.BAD, "no analog for 3.0 s")


def test_a_text_for_each_stream_or_for_those_in_the_same_state(lab: Lab) -> None:
    lab.send_status(stream("3d 6d"), stream("analog"))
    assert gateway_states(lab.source) == [State(Level.GOOD, "streaming 200.0 Hz")]
    rejected = stream("analog", problem="frames come, and all are rejected: x")
    lab.send_status(stream("6d", "waiting to reconnect", tries=3), rejected, stream("event", "dancing"))
    report = lab.source.report
    assert report is not None
    assert gateway_states(lab.source) == [
        State(level, f"{key}: {each.text}")
        for level, key, each in zip(
            (Level.BAD, Level.BAD, Level.WAITING), ("6d", "analog", "event"), report.streams, strict=True
        )
    ]


@pytest.mark.parametrize("has_status", [True, False])
def test_a_gateway_that_is_not_heard_is_not_said_to_stream(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, has_status: bool
) -> None:
    lab.send_markers(True)
    if has_status:
        lab.send_status(stream())
    source = lab.source
    assert bool(gateway_states(source)) == has_status
    wait(monkeypatch, 5)
    text = "gateway not heard for 5.0 s" if has_status else "no gateway heard"
    assert gateway_states(source) == [State(Level.BAD, text)]


NOW_S = 1_700_000_000.5


def test_live_data_and_their_time(lab: Lab) -> None:
    """The text differs every second, also without any source."""
    assert "No source is heard yet." in banner_html([], NOW_S)
    assert banner_html([], NOW_S) == banner_html([], NOW_S + 0.1) != banner_html([], NOW_S + 1)
    lab.send_markers(True)
    assert f"● live|lab|last data {clock_text(NOW_S)}|" in text_of(banner_html([lab.source], NOW_S))


def test_data_that_have_stopped_and_why(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.send_markers(True)
    assert lab.source
    wait(monkeypatch, 3)
    lab.send_status(stream(state="no measurement"))
    html = banner_html([lab.source], NOW_S)
    assert "class=stopped" in html
    state = data_state(lab.source).text
    text = f"|lab: {state}|. The picture is old.|last data {clock_text(NOW_S - 3)} · connected to 192"
    assert text in text_of(html)


def test_a_take_that_is_paused_is_not_a_failure(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.send_markers(True)
    source = lab.source
    assert "● recorded|lab" in text_of(banner_html([source], NOW_S, is_take=True))
    wait(monkeypatch, 3)
    assert f"● {data_state(source).text}|lab" in text_of(banner_html([source], NOW_S, is_take=True))
    assert "● paused|lab" in text_of(banner_html([source], NOW_S, is_take=True, is_paused=True))


def test_a_take_that_is_paused_has_no_rate_and_goes_on_as_before(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pause is not among the last seconds: of the rate, the visibility, and a stop."""
    lab.send_status(stream())
    lab.send_parameters("<The_3D><Markers>2</Markers><Frequency>200</Frequency></The_3D>")
    lab.send_markers(True, False)
    source = lab.source
    for _ in range(4):
        wait(monkeypatch, 0.1)
        lab.send_markers(True, False)
        lab.live.update()
    component = source.components["3d"]
    before = [component.rate_hz, *component.visible_shares, component.age_s]
    for _ in range(3):
        wait(monkeypatch, 20)
        lab.live.hold()
        assert lab.source is source
    assert [component.rate_hz, *component.visible_shares, component.age_s] == pytest.approx(before)
    text = text_of(source_html(source, is_take=True, is_paused=True))
    assert "|3d|2|paused|5|" in text
    assert "streaming" not in text


def test_many_sources_with_hostile_names() -> None:
    sources = [DisplayedSource("<img src=x>" + "y" * 1000, "MOCAP_X") for _ in range(64)]
    html = banner_html(sources, time.time())
    assert "<img" not in html
    assert html.count("&lt;img") == MAX_SHOWN_SOURCES
    assert "and 48 more sources" in html
    assert len(html) < 10_000
