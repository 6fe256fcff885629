import json

import pytest

from gateway.errors import ProtocolError
from gateway.messages.decode import MESSAGE_TYPES_BY_NAME, decode, to_json
from tests.unit.messages.samples import (
    command_messages,
    component_message,
    parameter_messages,
    status_of,
    take_message,
    tool_pose_messages,
    unknown_clock,
)
from tests.vectors import COMPONENTS, LONG_EVENTS, MARKERS

MISSING = [None] * 3

EVERY_MESSAGE = [
    *map(component_message, COMPONENTS),
    *tool_pose_messages(),
    status_of(),
    unknown_clock(),
    *parameter_messages(),
    *command_messages(),
    take_message(),
]


def test_every_message_is_decoded_by_its_fingerprint_and_can_be_written_as_json() -> None:
    """All types that the gateway publishes are known to the tools that show them."""
    for message in EVERY_MESSAGE:
        decoded = decode(message)
        assert type(decoded)._get_packed_fingerprint() == message[:8]
        assert decoded.encode() == message
        value = to_json(decoded)
        assert json.loads(json.dumps(value, allow_nan=False)) == value
    assert set(MESSAGE_TYPES_BY_NAME) == {type(decode(message)).__name__ for message in EVERY_MESSAGE}
    assert len(MESSAGE_TYPES_BY_NAME) == 14


def test_messages_of_unknown_types_are_rejected_with_their_fingerprint() -> None:
    """The number tells the versions of a message type apart."""
    for message in (b"", b"abc", 8 * b"\0", 100 * b"x"):
        with pytest.raises(
            ProtocolError, match=f"^{len(message)} bytes with fingerprint {message[:8].hex()} "
        ):
            decode(message)


def test_a_message_truncated_anywhere_is_rejected() -> None:
    """lcm-gen's decoders would return a part of it as if it were whole."""
    for message in EVERY_MESSAGE:
        for length in range(8, len(message)):
            with pytest.raises(ProtocolError, match=f"of {length} bytes is truncated"):
                decode(message[:length])


def test_missing_values_are_null_in_json() -> None:
    markers = to_json(decode(component_message(MARKERS)))["markers"]
    assert [[marker[axis] for axis in "xyz"] for marker in markers] == [[1.0, -2.5, 1000.25], MISSING]
    assert markers[1]["reliability"] == 999.0
    pose = to_json(decode(tool_pose_messages()[1]))
    assert (pose["visible"], pose["position_m"], pose["error_m"]) == (False, MISSING, None)


def test_json_has_every_field() -> None:
    assert to_json(decode(component_message(LONG_EVENTS))) == {
        "utime": 2_000,
        "capture_utime": 1_000,
        "sequence": 41,
        "session": 3,
        "parameters_version": 5,
        "frame_number": 6,
        "timestamp": 12500,
        "num_events": 2,
        "events": [
            dict(zip(LONG_EVENTS.fields, event, strict=True))
            for event in zip(*LONG_EVENTS.fields.values(), strict=True)
        ],
    }
