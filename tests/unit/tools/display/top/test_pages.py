"""What ``top`` finds out about sources, and its pages."""

import json
import time

import pytest

from gateway.client.history_requests import COMPLETE, HistoryAnswer, HistoryRequest
from gateway.client.sources import ReceivedSeries
from gateway.errors import QueryError
from gateway.messages.decode import json_text
from gateway.messages.source_report import Level, State
from gateway.rtc3d.components import ComponentType
from gateway.tools.display.live import DisplayedSource, LiveData
from gateway.tools.display.top import facts
from gateway.tools.display.top.pages import PAGES, TWO_GATEWAYS, TopPage, event_time
from gateway.tools.display.top.table import laid_out, sorted_by
from tests.support.statuses import count, loss, output, stream
from tests.support.takes import frame
from tests.support.waiting import wait_until
from tests.unit.tools.display.live_lab import Lab


def shown(page: str, *sources: DisplayedSource) -> list[str]:
    table = next(each for each in PAGES if each.name == page).table(sources)
    lines = laid_out(sorted_by(table, table.order), 200, table.order)
    return [" ".join("".join(text for text, _ in line).split()) for line in (lines.titles, *lines.body)]


def test_the_overview_has_a_line_per_source_and_one_per_component() -> None:
    live = LiveData()
    lab, stage = Lab("lab", live), Lab("stage", live)
    lab.send_status(stream("3d event"))
    stage.send_status(stream("6d", "waiting to reconnect"))
    lab.send_ones("3d", 0, 2, missing=(1,))
    _, heading, markers, event, gap, other, *_ = shown("overview", *live.update())
    assert (heading, gap, other) == ("lab: streaming 200.0 Hz", "", "stage: waiting for 192.0.2.9:3020")
    assert markers.startswith("3d 0.0 0 0 0 2.0/2.0 ")
    assert " 2 1 0.0" in markers
    assert event == "event 0.0 0 0 0 none so far"


def test_80_columns_show_the_latencies() -> None:
    """Latency is what many run ``top`` for, and 80 columns are what a terminal has."""
    lab = Lab()
    lab.send_status(stream("3d 6d"))
    lab.send_ones("3d", 0, 24)
    titles = laid_out(PAGES[0].table([lab.source]), 80).titles
    assert {"announced", "lost", "→gateway ms", "→here ms", "visible"} <= {text.strip() for text, _ in titles}


def test_the_overview_says_that_two_gateways_have_one_name() -> None:
    lab = Lab()
    for number in range(12):
        lab.send_ones("3d", number, 1)
        lab.send_ones("3d", 5000 + number, 1)
    assert TWO_GATEWAYS in shown("overview", lab.source)


def test_what_was_refilled_and_what_stays_lost() -> None:
    """It says whether a recording on this computer would be complete."""
    lab = Lab()

    def ask(series: ReceivedSeries, _request: HistoryRequest, _timeout_s: float) -> HistoryAnswer:
        if series.key != "3d":
            raise QueryError("the gateway keeps no such messages", code="disabled")
        kept = [frame(ComponentType.MARKERS, [(1, 2, 3, 0.1)], number)[1] for number in (7, 8)]
        return HistoryAnswer(kept, 1, 8, 9)

    lab.live.complete(ask, lambda *_: [], COMPLETE)
    for number in (0, 9):
        for key in ("3d", "analog"):
            lab.send_ones(key, number, 1)
    wait_until(lambda: all(series.check.num_lost for series in lab.live.all_series))
    titles, _, note, *rows = shown("overview", lab.source)
    assert "lost refilled" in titles
    assert note == "gaps are not filled: the gateway keeps no such messages"
    assert [row.split()[:4] for row in rows] == [["3d", "0.0", "6", "2"], ["analog", "0.0", "8", "0"]]


def test_markers_that_are_seen_least_come_first() -> None:
    lab = Lab()
    lab.send_labels("LASI", "RASI", "SACR")
    for number in range(1000):
        lab.send_ones("3d", number, 4, missing=(1, 3) if number < 500 else (2, 3) if number == 500 else (3,))
    lab.send_ones("6d", 0, 1)
    source = lab.source
    assert shown("markers", source)[1:] == [
        "marker 4 0.0 % missing mm lab",
        "RASI 50.0 % visible 1.0 1.0 1.0 mm lab",
        "SACR 99.9 % visible 1.0 1.0 1.0 mm lab",
        "LASI 100.0 % visible 1.0 1.0 1.0 mm lab",
    ]
    assert shown("tools", source)[1:] == ["tool 1 100.0 % visible 1.000 1.0 1.0 1.0 mm lab"]


def test_the_server_has_its_streams_their_clock_and_what_is_wrong() -> None:
    lab = Lab()
    ticking = stream("3d", session=3, byte_order="big", rate="AllFrames", lag_ms=1.5, reconnects=2)
    ticking.clock.has_clock, ticking.clock.drift_ppm, ticking.clock.uncertainty_us = True, 12.5, 40.0
    lab.send_status(ticking, stream("6d", limitations=["no SendParameters"], last_error="refused"))
    assert shown("server", lab.source)[1:] == [
        "lab from 192.0.2.9:3020 by gatewaypc (version 1.2.3)",
        "3d streaming 200.0 3 2 0 big AllFrames 1.5 12.50 40.0",
        "6d streaming 200.0 0 0 0 0.0",
        "6d: no SendParameters",
        f"6d: last error, {event_time(0)}: refused",
        "6d: its time stamps are no clock",
    ]


def test_drops_outputs_and_questions() -> None:
    lab = Lab()
    zenoh = output("zenoh", messages=[count("3d", 5), count("6d", 6)], queries=[count("ok", 3)])
    lcm = output("lcm", connected=False, problem="no route")
    lab.send_status(stream("3d", drops=[loss("skipped while behind", 8, 4)]), outputs=(zenoh, lcm))
    source = lab.source
    assert shown("drops", source)[1:] == ["lab stream 3d skipped while behind 8 4"]
    outputs = ["lab zenoh connected 11 3d 5, 6d 6", "lab lcm not connected 0", "lab to lcm: no route"]
    assert shown("outputs", source)[1:] == outputs
    assert shown("questions", source)[1:] == ["lab zenoh ok 3"]
    assert shown("overview", source)[1:3] == ["lab: streaming 200.0 Hz", "lab to lcm: no route"]


def test_events_have_a_time_and_the_newest_one_comes_first() -> None:
    lab = Lab()
    lab.send_ones("event", 0, 1)
    lab.send_ones("event", 1, 1)
    source = lab.source
    times = [event_time(event.capture_utime) for event in reversed(source.events)]
    parameters = "param1: 1; param2: 1; param3: 1"
    assert shown("events", source)[1:] == [f"{time} event 1 {parameters} lab" for time in times]
    assert [event_time(utime) for utime in (-(1 << 63), (1 << 63) - 1)] == ["?", "?"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_hostile_texts_keep_every_line_printable(page: TopPage) -> None:
    lab = Lab(name="lab")
    hostile = "\x1b]0;title\x07\u202e\u0301" + "漢" * 3000
    lab.send_labels("\u202eRASI", "漢" * 400, "e\u0301" * 100)
    lab.send_ones("3d", 0, 3)
    lab.send_ones("6d", 0, 3, missing=(0,))
    lab.send_ones("event", 0, 1)
    evil = stream(hostile, hostile, limitations=[hostile], last_error=hostile, frame_rate_hz=float("inf"))
    outputs = (output(hostile, problem=hostile, queries=[count(hostile, -5)]),)
    lab.send_status(evil, outputs=outputs, server=hostile)
    for width in (1, 40, 200):
        lines = laid_out(page.table([lab.source]), width)
        assert all(text.isprintable() for line in (lines.titles, *lines.body) for text, _ in line)
    assert laid_out(page.table([]), 80).body


HOSTILE = "\x1b[31mred\u202e\n" + "x" * 5000


def test_components_have_rates_losses_and_what_is_visible() -> None:
    lab = Lab()
    lab.send_labels("LASI", "RASI")
    lab.send_status(stream("3d 6d"))
    for sequence in (0, 1, 4):
        lab.send_ones("3d", sequence, 2, missing=(1,))
    markers, tools = facts.components(lab.source)
    assert (markers.component, markers.announced_rate_hz) == ("3d", 200)
    assert markers.sequence == facts.SequenceFacts(3, 2, 1, 0, has_two_gateways=False, num_refilled=None)
    assert (markers.num_items, markers.num_visible) == (2, 1)
    assert markers.to_gateway is not None
    assert markers.to_gateway.p50_ms == 2.0
    assert markers.to_here is not None
    assert (tools.component, tools.sequence.num_messages, tools.age_s) == ("6d", 0, None)


def test_data_that_stop_are_stopped_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    lab = Lab()
    lab.send_status(stream("3d"))
    lab.send_ones("3d", 0, 1)
    assert facts.state(lab.source) == State(Level.GOOD, "streaming 200.0 Hz")
    now_s = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s + 0.6)
    source = lab.source
    [component] = facts.components(source)
    assert component.is_stopped
    assert (component.rate_hz, component.num_visible) == (0, 0)
    assert facts.state(source) == State(Level.BAD, "streaming 200.0 Hz; stopped: 3d")
    [marker] = facts.items(source, ComponentType.MARKERS)
    assert not marker.is_visible
    assert marker.x is None


def test_state_in_the_words_of_the_status_line() -> None:
    lab = Lab()
    for streams, level, text in (
        ([], Level.WAITING, "its gateway reports no stream"),
        ([stream("3d"), stream("6d", "idle")], Level.WAITING, "3d streaming 200.0 Hz, 6d connected to "),
        ([stream("3d"), stream("6d", "stalled")], Level.BAD, "3d streaming 200.0 Hz, 6d no frames from "),
        ([stream("3d", problem="all are rejected")], Level.BAD, "all are rejected"),
    ):
        lab.send_status(*streams)
        found = facts.state(lab.source)
        assert (found.level, found.text[: len(text)]) == (level, text)


def test_a_gateway_that_is_silent_comes_before_what_it_said_last(monkeypatch: pytest.MonkeyPatch) -> None:
    lab = Lab()
    lab.send_status(stream("3d"))
    assert lab.source
    now_s = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s + 8)
    found = facts.state(lab.source)
    assert found == State(Level.BAD, "no status of its gateway for 8 s; is it running?")
    monkeypatch.undo()
    lab.send_status(stream("3d"))
    assert facts.state(lab.source).level is Level.GOOD


def test_losses_are_those_of_streams_outputs_and_of_the_way_here() -> None:
    lab = Lab()
    dropped = stream("3d", drops=[loss("skipped while behind", 8, 4)])
    lab.send_status(dropped, outputs=(output("zenoh", drops=[loss("put failed", 2, 1)]),))
    lab.send_ones("3d", 0, 1)
    lab.send_ones("3d", 7, 1)
    assert facts.losses(lab.source) == [
        facts.LossFacts("stream 3d", "skipped while behind", 8, 4),
        facts.LossFacts("output zenoh", "put failed", 2, 1),
        facts.LossFacts("received here", "missing in the sequence of messages", 6, None),
    ]


def test_texts_from_networks_are_cut_and_escaped() -> None:
    lab = Lab()
    lab.send_labels(HOSTILE.replace("\x1b", ""), "b")
    lab.send_ones("3d", 0, 2)
    lab.send_status(
        stream(HOSTILE, HOSTILE, limitations=[HOSTILE], last_error=HOSTILE, drops=[loss(HOSTILE, 1, 1)]),
        outputs=(
            output(HOSTILE, problem=HOSTILE, messages=[count(HOSTILE, 1)], queries=[count(HOSTILE, 1)]),
        ),
        server=HOSTILE,
        host=HOSTILE,
    )
    text = json_text(facts.source_facts(lab.source))
    assert text.isprintable()
    assert "xxxxx" in text
    assert len(text) < 20_000


COMPONENT_FIELDS = [
    *("component", "rate_hz", "announced_rate_hz", "num_messages", "num_lost", "num_gaps", "num_restarts"),
    *("has_two_gateways", "num_refilled", "capture_to_gateway_p50_ms", "capture_to_gateway_p99_ms"),
    *("gateway_to_here_p50_ms", "gateway_to_here_p99_ms", "num_items", "num_visible", "age_s", "is_stopped"),
    *("num_skipped", "num_malformed"),
]
"""What docs/reference/command-json.md promises, in this order."""


def test_everything_about_a_source_is_json() -> None:
    lab = Lab("stage")
    lab.send_status(stream("3d event", lag_ms=float("nan")), outputs=(output(),))
    lab.send_ones("3d", 0, 3, missing=(1,))
    lab.send_ones("event", 0, 2)
    found = json.loads(json_text(facts.source_facts(lab.source)))
    assert (found["source"], found["server"], found["host"]) == ("stage", "192.0.2.9:3020", "gatewaypc")
    assert (found["state"], found["level"]) == ("streaming 200.0 Hz", "ok")
    markers, events = found["components"]
    assert [*markers] == [*events] == COMPONENT_FIELDS
    assert (markers["num_messages"], markers["num_lost"], markers["num_visible"]) == (1, 0, 2)
    assert markers["capture_to_gateway_p50_ms"] == markers["capture_to_gateway_p99_ms"] == 2.0
    assert markers["gateway_to_here_p50_ms"] == markers["gateway_to_here_p99_ms"]
    assert found["markers"][1] == {
        "label": "marker 2",
        "visible_share": 0,
        "is_visible": False,
        "x": None,
        "y": None,
        "z": None,
        "unit": "mm",
        "error": None,
    }
    assert found["streams"][0]["lag_ms"] is None
    assert [event["label"] for event in found["events"]] == ["event 1", "event 1"]
