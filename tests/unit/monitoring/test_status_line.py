"""The line for people: one source with its streams, and outputs with a problem."""

import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.monitoring.status_line import output_lines, source_line
from gateway.outputs.status import OutputHealth
from gateway.rtc3d.components import ComponentType
from gateway.stream.state import StreamInput, StreamState
from gateway.stream.status import StreamStatus

LAB = SourceSettings(name="lab", host="192.0.2.9")
TWO = SourceSettings(
    name="lab",
    host="192.0.2.9",
    streams=(
        StreamSettings(components=(ComponentType.MARKERS,)),
        StreamSettings(components=(ComponentType.ANALOG,)),
    ),
)


@pytest.mark.parametrize(
    ("state", "tries", "line"),
    [
        (StreamState.STREAMING, 0, "lab: streaming 200.0 Hz"),
        (StreamState.WAITING, 0, "lab: waiting for 192.0.2.9:3020"),
        (StreamState.WAITING, 1, "lab: waiting for 192.0.2.9:3020, 1 try"),
        (StreamState.CONNECTING, 12, "lab: waiting for 192.0.2.9:3020, 12 tries"),
        (StreamState.HANDSHAKING, 1, "lab: connected to 192.0.2.9:3020, shaking hands"),
        (StreamState.IDLE, 0, "lab: connected to 192.0.2.9:3020, no frames asked for"),
        (StreamState.NO_MEASUREMENT, 0, "lab: connected to 192.0.2.9:3020, no measurement runs"),
        (StreamState.STALLED, 0, "lab: nothing comes from 192.0.2.9:3020"),
    ],
)
def test_every_state_has_words(state: StreamState, tries: int, line: str) -> None:
    assert source_line(LAB, [(StreamStatus("3d", state=state, tries=tries), 199.96)]) == line


def test_streams_in_one_state_are_told_once() -> None:
    waiting = [(StreamStatus(name, tries=3), 0.0) for name in ("3d", "analog")]
    assert source_line(TWO, waiting) == "lab: waiting for 192.0.2.9:3020, 3 tries"


def test_streams_in_different_states_are_told_apart() -> None:
    streams = [
        (StreamStatus("3d", state=StreamState.STREAMING), 200.0),
        (StreamStatus("analog", state=StreamState.STREAMING), 2000.0),
    ]
    assert source_line(TWO, streams) == "lab: 3d streaming 200.0 Hz, analog streaming 2000.0 Hz"


def test_outputs_are_told_while_they_cannot_send() -> None:
    health = {"zenoh": OutputHealth(False, "no router"), "lcm": OutputHealth(True)}
    assert output_lines(health.items()) == ["zenoh: no router"]


def test_tries_count_from_the_last_handshake() -> None:
    status = StreamStatus("3d")
    for happened in (StreamInput.DIAL, StreamInput.ENDED, StreamInput.DIAL):
        status.move(happened, "")
    assert status.tries == 2
    status.move(StreamInput.CONNECTED, "")
    assert status.tries == 2
    status.move(StreamInput.READY, "")
    assert status.tries == 0
