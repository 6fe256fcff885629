"""The texts about a ``status_t`` are those of the status line."""

from collections.abc import Sequence

import pytest
import rtc3d

from gateway.config.settings import SourceSettings
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.decode import decode
from gateway.monitoring.status_line import source_line
from gateway.publish.status_messages import status_message
from gateway.stream.state import StreamState
from gateway.stream.status import StreamStatus
from gateway.stream.status_text import message_texts, source_text

LAB = SourceSettings(name="lab", host="192.0.2.9")
Streams = Sequence[tuple[StreamStatus, float]]


def message_of(streams: Streams) -> rtc3d.status_t:
    server = f"{LAB.host}:{LAB.port}"
    message = status_message(
        source="lab",
        server=server,
        sequence=0,
        streams=streams,
        outputs=[],
        stall_timeout_s=2.0,
        frame=CoordinateFrame("lab"),
    )
    decoded: rtc3d.status_t = decode(message.encode())
    return decoded


@pytest.mark.parametrize("state", list(StreamState))
@pytest.mark.parametrize("tries", [0, 1, 12])
def test_a_status_message_has_the_words_of_the_status_line(state: StreamState, tries: int) -> None:
    streams = [(StreamStatus("3d 6d", state=state, tries=tries), 199.96)]
    assert source_line(LAB, streams) == f"lab: {source_text(message_texts(message_of(streams)))}"


def test_different_streams_are_listed_by_components() -> None:
    streams = [
        (StreamStatus("3d", state=StreamState.STREAMING), 200.0),
        (StreamStatus("analog", state=StreamState.STALLED), 0.0),
    ]
    text = source_text(message_texts(message_of(streams)))
    assert text == "3d streaming 200.0 Hz, analog no frames from 192.0.2.9:3020"
    assert source_line(LAB, streams) == f"lab: {text}"


def test_frames_that_are_all_rejected_are_no_streaming() -> None:
    rejected = StreamStatus("3d", state=StreamState.STREAMING)
    rejected.frame_rejected("component 7 is too short", 1)
    [(components, text)] = message_texts(message_of([(rejected, 200.0)]))
    assert (components, text) == ("3d", "frames come, and all are rejected: component 7 is too short")


def test_texts_of_a_hostile_message_are_escaped_and_cut() -> None:
    message = message_of([(StreamStatus("3d"), 0.0)])
    message.streams[0].state = "\x1b[2J" + "x" * 100_000
    message.streams[0].components = "3d\n6d"
    [(components, text)] = message_texts(message)
    assert components.isprintable()
    assert text.isprintable()
    assert len(text) < 2000


def test_a_status_without_streams_has_no_text() -> None:
    assert source_text(message_texts(message_of([]))) == ""
