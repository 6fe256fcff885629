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
STREAMS = tuple(StreamSettings(components=(each,)) for each in (ComponentType.MARKERS, ComponentType.ANALOG))
TWO = SourceSettings(name="lab", host="192.0.2.9", streams=STREAMS)


SERVER = "192.0.2.9:3020"


@pytest.mark.parametrize(
    ("state", "tries", "line"),
    [
        (StreamState.STREAMING, 0, "streaming 200.0 Hz"),
        (StreamState.WAITING, 0, f"waiting for {SERVER}"),
        (StreamState.WAITING, 1, f"waiting for {SERVER}, 1 try"),
        (StreamState.CONNECTING, 12, f"waiting for {SERVER}, 12 tries"),
        (StreamState.HANDSHAKING, 1, f"connected to {SERVER}, handshake in progress"),
        (StreamState.IDLE, 0, f"connected to {SERVER}, no frames requested"),
        (StreamState.NO_MEASUREMENT, 0, f"connected to {SERVER}, no measurement running"),
        (StreamState.STALLED, 0, f"no frames from {SERVER}"),
    ],
)
def test_every_state_has_a_text_that_streams_share(state: StreamState, tries: int, line: str) -> None:
    streams = [(StreamStatus(name, state=state, tries=tries), 199.96) for name in ("3d", "analog")]
    assert source_line(LAB, streams[:1]) == source_line(TWO, streams) == f"lab: {line}"


def test_streams_with_different_texts_are_listed_by_components() -> None:
    rates = {"3d": 200.0, "analog": 2000.0}
    streams = [(StreamStatus(name, state=StreamState.STREAMING), rate_hz) for name, rate_hz in rates.items()]
    assert source_line(TWO, streams) == "lab: 3d streaming 200.0 Hz, analog streaming 2000.0 Hz"


def test_only_outputs_that_cannot_send_or_lose_something_have_a_line() -> None:
    health = {"zenoh": OutputHealth(False, "no router"), "lcm": OutputHealth(True, "was away")}
    assert output_lines(health.items()) == ["zenoh: no router"]
    losses = Losses(logging.getLogger("tests"), "lab to zenoh")
    losses.lost("no router", "start it", messages=5)
    lines = loss_lines({"lab to zenoh": losses.report(), "lab to lcm": []}.items())
    assert lines == ["lab to zenoh: lost in the last minute: 5 messages of 1 frame (no router)"]


def test_what_a_stream_lost_in_the_last_minute_follows_its_state() -> None:
    status = StreamStatus("3d 6d", state=StreamState.STREAMING)
    for _ in range(436):
        status.frame_skipped(2)
    assert source_line(LAB, [(status, 200.0)]) == (
        "lab: streaming 200.0 Hz, lost in the last minute: 872 messages of 436 frames (skipped while behind)"
    )


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
