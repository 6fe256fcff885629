"""Messages decoded by their fingerprints, and as JSON."""

import json
import math
from typing import Any

import pytest

from gateway.errors import ProtocolError
from gateway.messages.decode import MESSAGE_TYPES_BY_NAME, decode, json_bytes, json_text, to_json
from gateway.rtc3d.parameters import Parameters, ParametersForce, Plate, Point
from tests.support.message_vectors import VECTORS
from tests.support.vectors import LONG_EVENTS, MARKERS
from tests.unit.messages.samples import component_message, tool_pose_messages

MISSING = [None] * 3


def plain(value: Any) -> Any:
    """Return what JSON says about a value, found independently of ``json_text``."""
    if hasattr(value, "__slots__"):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


EVERY_MESSAGE = [vector.data for vector in VECTORS]
"""Of each type that the gateway publishes or receives."""


def test_every_message_is_decoded_by_its_fingerprint_and_can_be_written_as_json() -> None:
    """All types that the gateway publishes are known to the tools that show them."""
    for message in EVERY_MESSAGE:
        decoded = decode(message)
        assert type(decoded)._get_packed_fingerprint() == message[:8]
        assert decoded.encode() == message
        value = plain(decoded)
        assert to_json(decoded) == value
        assert json_text(decoded) == json.dumps(value, separators=(",", ":"), ensure_ascii=False)
    assert set(MESSAGE_TYPES_BY_NAME) == {type(decode(message)).__name__ for message in EVERY_MESSAGE}
    assert len(MESSAGE_TYPES_BY_NAME) == 16


def test_messages_that_are_unknown_or_truncated_anywhere_are_rejected() -> None:
    """lcm-gen's decoders would return a part as if it were whole; the fingerprint tells versions apart."""
    for message in (b"", b"abc", 8 * b"\0", 100 * b"x"):
        text = f"^{len(message)} bytes with fingerprint {message[:8].hex()} "
        with pytest.raises(ProtocolError, match=text):
            decode(message)
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
    events = zip(*LONG_EVENTS.fields.values(), strict=True)
    stamp = {"utime": 2_000, "capture_utime": 1_000, "sequence": 41, "session": 3, "parameters_version": 5}
    content = {"frame_number": 6, "timestamp": 12500, "num_events": 2}
    items = [dict(zip(LONG_EVENTS.fields, event, strict=True)) for event in events]
    assert to_json(decode(component_message(LONG_EVENTS))) == stamp | content | {"events": items}


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ([math.inf, -math.inf, math.nan, -0.0, 1e300, 0.1], "[null,null,null,-0.0,1e+300,0.1]"),
        ({"Käfig": (1, True, False, None)}, '{"Käfig":[1,true,false,null]}'),
        ('"\\\n\x00\u2028', '"\\"\\\\\\n\\u0000\u2028"'),
        *(([], "[]"), ({}, "{}")),
    ],
)
def test_values_as_json(value: object, text: str) -> None:
    assert json_text(value) == text


def test_parameters_are_objects_of_their_fields() -> None:
    parameters = Parameters(force=ParametersForce((Plate("1", corners=(Point(x=1.0),)),)))
    assert json.loads(json_text(parameters)) == plain(parameters)


def test_json_is_compact_and_in_utf8_and_has_only_its_own_numbers() -> None:
    expected = '{"name":"Käfig","values":[1,2.5,null]}'.encode()
    assert json_bytes({"name": "Käfig", "values": [1, 2.5, None]}) == expected
    for value in (math.nan, math.inf):
        with pytest.raises(ValueError, match="not JSON compliant"):
            json_bytes([value])
