import json
import time

import pytest

from gateway.live.live_data import LiveData
from gateway.messages.json_text import json_text
from gateway.top import facts
from tests.statuses import count, loss, output, stream
from tests.unit.top.live_lab import LiveLab

HOSTILE = "\x1b[31mred\u202e\n" + "x" * 5000


def test_components_have_rates_losses_and_what_is_visible() -> None:
    lab = LiveLab()
    lab.labels("LASI", "RASI", rate_hz=200)
    lab.status(stream("3d 6d"))
    for sequence in (0, 1, 4):
        lab.frame("3d", sequence, 2, missing=(1,))
    markers, tools = facts.components(lab.source())
    assert (markers.component, markers.announced_rate_hz) == ("3d", 200)
    assert (markers.num_lost, markers.num_gaps, markers.num_restarts) == (2, 1, 0)
    assert (markers.num_items, markers.num_visible, markers.num_messages) == (2, 1, 3)
    assert markers.capture_to_gateway_p50_ms == 2.0
    assert markers.gateway_to_here_p99_ms is not None
    assert (tools.component, tools.num_messages, tools.age_s) == ("6d", 0, None)


def test_data_that_stop_are_stopped_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    lab = LiveLab()
    lab.status(stream("3d"))
    lab.frame("3d", 0, 1)
    assert facts.state(lab.source()) == facts.StateFacts("streaming 200.0 Hz", "ok")
    now_s = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s + 0.6)
    source = lab.source()
    [component] = facts.components(source)
    assert component.is_stopped
    assert (component.rate_hz, component.num_visible) == (0, 0)
    assert facts.state(source) == facts.StateFacts("streaming 200.0 Hz; stopped: 3d", "error")
    [marker] = facts.markers(source)
    assert not marker.is_visible
    assert marker.x is None


@pytest.mark.parametrize(
    ("state", "level", "text"),
    [
        ("streaming", "ok", "streaming 200.0 Hz"),
        ("no measurement", "warning", "connected to 192.0.2.20:3020, no measurement running"),
        ("waiting to reconnect", "error", "waiting for 192.0.2.20:3020, 3 tries"),
        ("stalled", "error", "no frames from 192.0.2.20:3020"),
        ("anything", "warning", "anything"),
    ],
)
def test_state_in_the_words_of_the_status_line(state: str, level: str, text: str) -> None:
    lab = LiveLab()
    lab.status(stream("3d", state, tries=3))
    assert facts.state(lab.source()) == facts.StateFacts(text, level)


def test_a_problem_of_a_stream_is_an_error() -> None:
    lab = LiveLab()
    lab.status(stream("3d", problem="frames come, and all are rejected: too short"))
    found = facts.state(lab.source())
    assert found == facts.StateFacts("frames come, and all are rejected: too short", "error")


def test_a_gateway_that_is_silent_comes_before_what_it_said_last(monkeypatch: pytest.MonkeyPatch) -> None:
    lab = LiveLab()
    lab.status(stream("3d"))
    lab.source()
    now_s = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s + 8)
    found = facts.state(lab.source())
    assert found == facts.StateFacts("no status of its gateway for 8 s; is it running?", "error")
    monkeypatch.undo()
    lab.status(stream("3d"))
    assert facts.state(lab.source()).level == "ok"


def test_two_gateways_with_one_name_are_noticed() -> None:
    lab = LiveLab()
    for number in range(12):
        lab.frame("3d", number, 1)
        lab.frame("3d", 5000 + number, 1)
    source = lab.source()
    assert facts.has_two_gateways(source)
    assert facts.components(source)[0].has_two_gateways


def test_visibility_of_markers_and_tools() -> None:
    lab = LiveLab()
    lab.labels("LASI", "RASI")
    for number in range(4):
        lab.frame("3d", number, 2, missing=() if number == 3 else (0,))
        lab.frame("6d", number, 1)
    source = lab.source()
    left, right = facts.markers(source)
    assert (left.label, left.visible_share, left.is_visible, left.x, left.unit) == (
        "LASI",
        0.25,
        True,
        1,
        "mm",
    )
    assert (right.label, right.visible_share, right.error) == ("RASI", 1, None)
    [tool] = facts.tools(source)
    assert (tool.label, tool.error, tool.visible_share) == ("tool 1", 1, 1)


def test_losses_are_those_of_streams_outputs_and_of_the_way_here() -> None:
    lab = LiveLab()
    lab.status(
        stream("3d", drops=[loss("skipped while behind", 8, 4)]),
        outputs=(output("zenoh", drops=[loss("put failed", 2, 1)]),),
    )
    lab.frame("3d", 0, 1)
    lab.frame("3d", 7, 1)
    assert facts.losses(lab.source()) == [
        facts.LossFacts("stream 3d", "skipped while behind", 8, 4),
        facts.LossFacts("output zenoh", "put failed", 2, 1),
        facts.LossFacts("received here", "missing in the sequence of messages", 6, None),
    ]


def test_outputs_have_messages_and_queries() -> None:
    lab = LiveLab()
    messages, queries = [count("3d", 5), count("6d", 6)], [count("ok", 3), count("rate", 1)]
    lab.status(
        outputs=(output("lcm", connected=False, problem="no route", messages=messages, queries=queries),)
    )
    assert facts.outputs(lab.source()) == [
        facts.OutputFacts("lcm", False, "no route", {"3d": 5, "6d": 6}, {"ok": 3, "rate": 1})
    ]


def test_texts_from_networks_are_cut_and_escaped() -> None:
    lab = LiveLab()
    lab.labels(HOSTILE.replace("\x1b", ""), "b")
    lab.frame("3d", 0, 2)
    lab.status(
        stream(HOSTILE, HOSTILE, limitations=[HOSTILE], last_error=HOSTILE, drops=[loss(HOSTILE, 1, 1)]),
        outputs=(
            output(HOSTILE, problem=HOSTILE, messages=[count(HOSTILE, 1)], queries=[count(HOSTILE, 1)]),
        ),
        server=HOSTILE,
        host=HOSTILE,
    )
    text = json_text(facts.source_facts(lab.source()))
    assert text.isprintable()
    assert "xxxxx" in text
    assert len(text) < 20_000


def test_a_status_with_very_many_entries_is_cut() -> None:
    lab = LiveLab()
    lab.status(*[stream(str(number)) for number in range(1000)])
    assert len(facts.streams(lab.source())) == 50


def test_everything_about_a_source_is_json() -> None:
    lab = LiveLab(LiveData(), "stage")
    lab.status(stream("3d event", lag_ms=float("nan")), outputs=(output(),))
    lab.frame("3d", 0, 3, missing=(1,))
    lab.frame("event", 0, 2)
    found = json.loads(json_text(facts.source_facts(lab.source())))
    assert (found["source"], found["server"], found["host"]) == ("stage", "192.0.2.20:3020", "gw1")
    assert found["components"][0]["num_visible"] == 2
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
