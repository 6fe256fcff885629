import json
import math
from typing import Any

import pytest
import rtc3d

from gateway.errors import ProtocolError
from gateway.messages.decode import MESSAGE_TYPES_BY_NAME, decode, one_line, to_json
from gateway.messages.splice import splice
from gateway.messages.stamp import Stamp
from gateway.messages.tool_pose import tool_poses
from gateway.outputs.status import OutputHealth, OutputStatus
from gateway.publish.status_messages import clock_message, status_message
from gateway.stream.state import StreamState
from gateway.stream.status import StreamStatus
from tests.unit.messages.received import received
from tests.vectors import ANALOG, COMPONENTS, FORCE, LONG_EVENTS, MARKERS, TOOLS, ComponentVector

STAMP = Stamp(utime=2_000, capture_utime=1_000, session=3)
MISSING = [None] * 3


def message_of(vector: ComponentVector) -> bytes:
    return splice(received(vector), STAMP, 41)


def poses() -> list[bytes]:
    return tool_poses(received(TOOLS), STAMP, [41, 42])


def status(**stream: Any) -> bytes:
    outputs = [
        (OutputStatus("zenoh"), OutputHealth(True)),
        (OutputStatus("lcm"), OutputHealth(False, "no multicast: ip route add")),
    ]
    streams = [(StreamStatus("3d 6d", **stream), 59.96)]
    message = status_message(
        source="lab", server="192.0.2.20:3020", sequence=17, streams=streams, outputs=outputs
    )
    return bytes(message.encode())


def clock() -> bytes:
    encoded: bytes = clock_message(3, 17, StreamStatus("3d 6d")).encode()
    return encoded


def parameters() -> list[bytes]:
    """A message, a request and a reply as they go over LCM."""
    told, request, reply = rtc3d.parameters_t(), rtc3d.parameters_request_t(), rtc3d.parameters_reply_t()
    told.xml = reply.xml = "<RT_Parameters/>"
    request.requester = reply.requester = "viewer"
    return [told.encode(), request.encode(), reply.encode()]


EVERY_KIND = [*map(message_of, COMPONENTS), *poses(), status(), clock(), *parameters()]
every_kind = pytest.mark.parametrize(
    "message", EVERY_KIND, ids=lambda message: type(decode(message)).__name__
)


def test_all_published_types_are_known() -> None:
    assert set(MESSAGE_TYPES_BY_NAME) == {type(decode(message)).__name__ for message in EVERY_KIND}
    assert len(MESSAGE_TYPES_BY_NAME) == 11


@every_kind
def test_a_message_is_told_by_its_fingerprint(message: bytes) -> None:
    decoded = decode(message)
    assert type(decoded)._get_packed_fingerprint() == message[:8]
    assert decoded.encode() == message


@pytest.mark.parametrize("message", [b"", b"abc", 8 * b"\0", 100 * b"x"])
def test_bytes_of_others_are_refused_with_their_fingerprint(message: bytes) -> None:
    with pytest.raises(
        ProtocolError, match=f"^{len(message)} bytes with the fingerprint {message[:8].hex()} "
    ):
        decode(message)


@every_kind
def test_a_message_cut_short_anywhere_is_refused(message: bytes) -> None:
    for length in range(8, len(message)):
        with pytest.raises(ProtocolError, match=f"of {length} bytes is cut short"):
            decode(message[:length])


def test_what_is_missing_is_null_in_json() -> None:
    markers = to_json(decode(message_of(MARKERS)))["markers"]
    assert [[marker[axis] for axis in "xyz"] for marker in markers] == [[1.0, -2.5, 1000.25], MISSING]
    assert markers[1]["reliability"] == 999.0
    pose = to_json(decode(poses()[1]))
    assert (pose["visible"], pose["position_m"], pose["error_m"]) == (False, MISSING, None)


def test_json_has_every_field_by_its_name() -> None:
    assert to_json(decode(message_of(LONG_EVENTS))) == {
        "utime": 2_000,
        "capture_utime": 1_000,
        "sequence": 41,
        "session": 3,
        "frame_number": 6,
        "timestamp": 12500,
        "num_events": 2,
        "events": [
            dict(zip(LONG_EVENTS.fields, event, strict=True))
            for event in zip(*LONG_EVENTS.fields.values(), strict=True)
        ],
    }


@every_kind
def test_every_message_can_be_written_as_json(message: bytes) -> None:
    value = to_json(decode(message))
    assert json.loads(json.dumps(value, allow_nan=False)) == value


def test_infinity_is_null_in_json() -> None:
    assert to_json([math.inf, -math.inf, math.nan, 0.0]) == [None, None, None, 0.0]


@pytest.mark.parametrize(
    ("message", "line"),
    [
        (
            message_of(MARKERS),
            "#41 frame 16909060 at 4328.7194 s: 2 markers, 1 missing, the first seen at (1, -2.5, 1000)",
        ),
        (
            message_of(TOOLS),
            "#41 frame 4 at 0.0075 s: 2 tools, 1 missing, the first seen at (100, -200, 1600)",
        ),
        (message_of(ANALOG), "#41 frame 2 at 0.0025 s: 3 channels, (0.1, -1.5e+04, 0) …"),
        (message_of(FORCE), "#41 frame 3 at 0.0050 s: 2 plates, forces (1.5, -0.75, 800); (4, 5, 6)"),
        (
            message_of(LONG_EVENTS),
            "#41 frame 6 at 0.0125 s: 2 events: id 0x123456 (7, 1, -1); id 0x2 (1065353216, -1, -1)",
        ),
        (
            poses()[0],
            "#41 frame 4 at 0.0075 s: position (0.1, -0.2, 1.6) m, orientation xyzw (-0.4, 0.4, 0.2, 0.8)",
        ),
        (poses()[1], "#42 frame 4 at 0.0075 s: out of view"),
        (clock(), "#17 the server's time stamps make no clock (3d 6d)"),
        (
            status(state=StreamState.STREAMING, frames_in=600, reconnects=1, last_error="gone"),
            "#17 lab at 192.0.2.20:3020: "
            "[3d 6d] streaming 60.0 Hz, 600 frames, 1 reconnects, last error: gone; "
            "outputs: zenoh ok; lcm no multicast: ip route add",
        ),
        (
            status(),
            "#17 lab at 192.0.2.20:3020: [3d 6d] waiting to reconnect 60.0 Hz, 0 frames, 0 reconnects; "
            "outputs: zenoh ok; lcm no multicast: ip route add",
        ),
    ],
    ids=[
        "markers",
        "tools",
        "analog",
        "force",
        "events",
        "pose",
        "pose out of view",
        "clock",
        "status while streaming",
        "status while waiting",
    ],
)
def test_one_line_shows_what_matters_first(message: bytes, line: str) -> None:
    assert one_line(decode(message)) == line


def test_one_line_of_nothing_seen_has_no_position() -> None:
    message = rtc3d.markers_t()
    assert one_line(message).endswith("0 markers, 0 missing")
