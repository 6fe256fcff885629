"""The state of a source: do data come, and what does its gateway say?"""

import time

import pytest

from gateway.rtc3d.components import ComponentType
from gateway.stream.status_text import Level
from gateway.view.state_text import State, data_state, gateway_states, states_html
from tests.statuses import stream
from tests.unit.view.live_lab import Lab


def wait(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    now_s = time.monotonic() + seconds
    monkeypatch.setattr(time, "monotonic", lambda: now_s)


@pytest.fixture
def lab() -> Lab:
    return Lab()


def test_before_the_first_data(lab: Lab) -> None:
    lab.send_status()
    assert data_state(lab.source) == State(Level.WAITING, "no data yet")


def test_data_that_come(lab: Lab) -> None:
    lab.send_markers(True)
    assert data_state(lab.source) == State(Level.GOOD, "live")


def test_data_that_have_stopped(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.send_markers(True)
    lab.send(ComponentType.EVENT, [(1, 2, 3, 4, 5)])
    source = lab.source
    wait(monkeypatch, 12)
    assert data_state(source) == State(Level.BAD, "no data for 12 s")


def test_one_component_that_has_stopped(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.send(ComponentType.ANALOG, [1.5])
    assert lab.source
    wait(monkeypatch, 3)
    lab.send_markers(True)
    assert data_state(lab.source) == State(Level.BAD, "no analog for 3.0 s")


def test_one_text_for_streams_in_the_same_state(lab: Lab) -> None:
    lab.send_status(stream("3d 6d"), stream("analog"))
    assert gateway_states(lab.source) == [State(Level.GOOD, "streaming 200.0 Hz")]


def test_a_text_for_each_stream(lab: Lab) -> None:
    lab.send_status(
        stream("3d", "no measurement"),
        stream("6d", "waiting to reconnect", tries=3),
        stream("analog", problem="frames come, and all are rejected: x"),
        stream("event", "dancing"),
    )
    assert gateway_states(lab.source) == [
        State(Level.WAITING, "3d: connected to 192.0.2.9:3020, no measurement running"),
        State(Level.BAD, "6d: waiting for 192.0.2.9:3020, 3 tries"),
        State(Level.BAD, "analog: frames come, and all are rejected: x"),
        State(Level.WAITING, "event: dancing"),
    ]


def test_a_gateway_that_is_not_heard_is_not_said_to_stream(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.send_status(stream())
    source = lab.source
    wait(monkeypatch, 5)
    assert gateway_states(source) == [State(Level.BAD, "gateway not heard for 5.0 s")]


def test_a_source_without_a_status(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.send_markers(True)
    source = lab.source
    assert gateway_states(source) == []
    wait(monkeypatch, 5)
    assert gateway_states(source) == [State(Level.BAD, "no gateway heard")]


def test_states_are_escaped() -> None:
    assert states_html([State(Level.BAD, "<b>")]) == "<p class=bad>&lt;b&gt;</p>"
