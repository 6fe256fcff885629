"""The texts of the status line for sources, streams and outputs with a problem."""

import logging

import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import LinkError
from gateway.losses import Losses
from gateway.monitoring.status_line import loss_lines, output_lines, source_line
from gateway.outputs.status import OutputHealth
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.protocol_state import ProtocolState
from gateway.stream.state import StreamState
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
        (StreamState.HANDSHAKING, 1, "lab: connected to 192.0.2.9:3020, handshake in progress"),
        (StreamState.IDLE, 0, "lab: connected to 192.0.2.9:3020, no frames requested"),
        (StreamState.NO_MEASUREMENT, 0, "lab: connected to 192.0.2.9:3020, no measurement running"),
        (StreamState.STALLED, 0, "lab: no frames from 192.0.2.9:3020"),
    ],
)
def test_every_state_has_a_text(state: StreamState, tries: int, line: str) -> None:
    assert source_line(LAB, [(StreamStatus("3d", state=state, tries=tries), 199.96)]) == line


def test_streams_with_the_same_text_are_combined() -> None:
    waiting = [(StreamStatus(name, tries=3), 0.0) for name in ("3d", "analog")]
    assert source_line(TWO, waiting) == "lab: waiting for 192.0.2.9:3020, 3 tries"


def test_streams_with_different_texts_are_listed_by_components() -> None:
    streams = [
        (StreamStatus("3d", state=StreamState.STREAMING), 200.0),
        (StreamStatus("analog", state=StreamState.STREAMING), 2000.0),
    ]
    assert source_line(TWO, streams) == "lab: 3d streaming 200.0 Hz, analog streaming 2000.0 Hz"


def test_only_outputs_that_cannot_send_have_a_line() -> None:
    health = {"zenoh": OutputHealth(False, "no router"), "lcm": OutputHealth(True, "was away")}
    assert output_lines(health.items()) == ["zenoh: no router"]


def test_what_a_stream_lost_in_the_last_minute_follows_its_state() -> None:
    status = StreamStatus("3d 6d", state=StreamState.STREAMING)
    for _ in range(436):
        status.frame_skipped(2)
    assert source_line(LAB, [(status, 200.0)]) == (
        "lab: streaming 200.0 Hz, lost in the last minute: 872 messages of 436 frames (skipped while behind)"
    )


def test_only_outputs_that_lose_something_have_a_line() -> None:
    losses = Losses(logging.getLogger("tests"), "lab to zenoh")
    losses.lost("no router", "start it", messages=5)
    assert loss_lines({"lab to zenoh": losses.report(), "lab to lcm": []}.items()) == [
        "lab to zenoh: lost in the last minute: 5 messages of 1 frame (no router)"
    ]


def test_tries_are_counted_since_the_last_handshake() -> None:
    status = StreamStatus("3d")
    status.connecting("server")
    status.disconnected(LinkError("connection refused"))
    status.connecting("server")
    assert status.tries == 2
    status.connected("server")
    assert status.tries == 2
    status.handshake_done(ProtocolState.REQUESTED, "server", "StreamFrames")
    assert status.tries == 0
