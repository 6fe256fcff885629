"""Keys and channels, and LCM messages against lcm_types/vectors/ and lcm-gen's types."""

from typing import Any

import pytest
import rtc3d

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.decode import MESSAGE_TYPES_BY_NAME, decode
from gateway.messages.encode import (
    CONTENT_OFFSET,
    ITEMS_OFFSET,
    MESSAGE_TYPES,
    Stamp,
    encode_message,
    lcm_type_name,
    message_timestamp_us,
    tool_poses,
    with_sequence,
)
from gateway.messages.texts import encode_within_limits
from gateway.messages.topics import escape_key_chunk, lcm_channel, unique_name, zenoh_key
from gateway.rtc3d.components import ComponentType
from tests.support.message_vectors import FOLDER, VECTORS, MessageVector, difference, to_vector_values
from tests.support.vectors import ANALOG, FORCE, LONG_EVENTS, MARKERS, SHORT_EVENTS, TOOLS, ComponentVector
from tests.unit.messages.samples import received

STAMP = Stamp(1_700_000_000_000_001, 1_700_000_000_000_000, session=3, parameters_version=5)
SEQUENCE = 41

each_vector = pytest.mark.parametrize("vector", VECTORS, ids=str)


def from_vector_values(lcm_type: Any, values: dict[str, Any]) -> Any:
    """Return an LCM object with the values of a vector."""
    message = lcm_type()
    for field, type_name in zip(lcm_type.__slots__, lcm_type.__typenames__, strict=True):
        setattr(message, field, _from_values(type_name, values[field]))
    return message


def _from_values(type_name: str, value: Any) -> Any:
    if isinstance(value, list):
        return [_from_values(type_name, item) for item in value]
    if isinstance(value, dict):
        return from_vector_values(getattr(rtc3d, type_name.removeprefix("rtc3d.")), value)
    return float(value) if type_name in {"float", "double"} else value


def test_each_message_type_has_vectors_and_each_vector_a_name() -> None:
    assert {path.stem for path in FOLDER.glob("*.json")} == set(MESSAGE_TYPES_BY_NAME)
    assert len({str(vector) for vector in VECTORS}) == len(VECTORS)


@each_vector
def test_the_values_of_a_vector_are_its_bytes(vector: MessageVector) -> None:
    """The generated types and the gateway read the bytes alike, and write them again."""
    assert b"".join(part for part, _ in vector.fields) == vector.data
    decoded = decode(vector.data)
    assert type(decoded) is vector.lcm_type
    for each in (decoded, vector.lcm_type.decode(vector.data)):
        assert difference(vector.lcm_type, vector.values, to_vector_values(each)) is None
    encoded = from_vector_values(vector.lcm_type, vector.values).encode()
    # lcm-gen encodes the NaN of Python; servers mark what is missing with a NaN of which all bits are set.
    assert encoded.replace(b"\x7f\xc0\0\0", b"\xff" * 4) == vector.data.replace(b"\x7f\xc0\0\0", b"\xff" * 4)


@pytest.mark.parametrize(
    ("component", "name"),
    [
        (MARKERS, "two markers, the second missing"),
        (TOOLS, "two tools, the second out of view"),
        (ANALOG, "three channels"),
        (FORCE, "two plates"),
        (SHORT_EVENTS, "two events that the server sent with 16 bytes"),
        (LONG_EVENTS, "two events that the server sent with 24 bytes"),
    ],
)
def test_the_gateway_publishes_the_bytes_of_the_vectors(component: ComponentVector, name: str) -> None:
    """Fingerprint, prefix and big-endian component, whatever the byte order and form of the server's."""
    type_name = MESSAGE_TYPES[ComponentType(component.type)].__name__
    [vector] = [vector for vector in VECTORS if (vector.type_name, vector.name) == (type_name, name)]
    messages = [encode_message(received(component, order), STAMP, SEQUENCE) for order in ("big", "little")]
    assert messages == [vector.data] * 2
    if component is not SHORT_EVENTS:
        assert vector.data[CONTENT_OFFSET:] == component.wire["big"][8:]
        assert vector.data[ITEMS_OFFSET:] == component.wire["big"][24:]


def test_the_gateway_publishes_the_bytes_for_the_poses_of_tools() -> None:
    vectors = {vector.name: vector.data for vector in VECTORS if vector.type_name == "tool_pose_t"}
    for order in ("big", "little"):
        poses = tool_poses(received(TOOLS, order), STAMP, [SEQUENCE, SEQUENCE], CoordinateFrame("lab"))
        assert poses == [vectors["the first tool of the tools_t vector"], vectors["out of view"]]


def test_another_sequence_number_changes_nothing_else() -> None:
    """A reply to a query has the content of the newest sample, and its time stamp is found in place."""
    message = encode_message(received(MARKERS), STAMP, SEQUENCE)
    assert with_sequence(message, -1) == encode_message(received(MARKERS), STAMP, -1)
    assert message_timestamp_us(message) == MARKERS.timestamp_us


def test_the_name_of_an_lcm_type_is_its_encoding_on_zenoh() -> None:
    assert lcm_type_name(rtc3d.markers_t) == "rtc3d.markers_t"


@pytest.mark.parametrize(
    ("number", "limited"),
    [(2**63 - 1, 2**63 - 1), (2**63, 2**63 - 1), (-(2**63), -(2**63)), (-(2**63) - 1, -(2**63))],
)
def test_a_number_beyond_its_field_becomes_the_nearest_one(number: int, limited: int) -> None:
    """No number that a server makes the gateway compute prevents its status."""
    clock = rtc3d.clock_t()
    clock.utime = clock.clock.offset_us = number
    clock.clock.uncertainty_us = 10.0**300
    clock.components = "a\x1bb"
    decoded = rtc3d.clock_t.decode(encode_within_limits(clock))
    assert (decoded.utime, decoded.clock.offset_us, decoded.components) == (limited, limited, r"a\x1bb")
    assert decoded.clock.uncertainty_us >= 3e38


# Keys and channels --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "key", "channel"),
    [
        (("3d",), "mocap/lab/3d", "MOCAP_LAB_3D"),
        (("status",), "mocap/lab/status", "MOCAP_LAB_STATUS"),
        (("6d", "Probe"), "mocap/lab/6d/Probe", "MOCAP_LAB_6D_PROBE"),
        (("6d", "tool 1"), "mocap/lab/6d/tool%201", "MOCAP_LAB_6D_TOOL_1"),
    ],
)
def test_keys_and_channels_are_as_documented(path: tuple[str, ...], key: str, channel: str) -> None:
    assert (zenoh_key("mocap", "lab", *path), lcm_channel("MOCAP", "lab", *path)) == (key, channel)


@pytest.mark.parametrize(
    ("label", "chunk", "channel"),
    [
        ("Probe_1.a-b~", "Probe_1.a-b~", "PROBE_1_A_B"),
        *(("a/b", "a%2Fb", "A_B"), ("*", "%2A", "_"), ("a$*b", "a%24%2Ab", "A_B"), ("", "%", "_")),
        *(("what?#1", "what%3F%231", "WHAT_1"), ("100%", "100%25", "100"), ("@adv", "%40adv", "ADV")),
        *(("Fuß links", "Fu%C3%9F%20links", "FUSS_LINKS"), ("膝", "%E8%86%9D", "_")),
        ("(left) -- foot!", "%28left%29%20--%20foot%21", "LEFT_FOOT"),
    ],
)
def test_characters_that_are_refused_in_a_label_are_replaced(label: str, chunk: str, channel: str) -> None:
    """Zenoh's are percent-escaped, LCM's become one underscore."""
    assert escape_key_chunk(label) == chunk
    assert lcm_channel("MOCAP", "lab", "6d", label) == f"MOCAP_LAB_6D_{channel}"


@pytest.mark.parametrize(
    ("taken", "suffix"),
    [(set(), ""), ({"PROB"}, ""), ({"PROBE"}, "_2"), ({"PROBE", "PROBE_2", "PROBE_4"}, "_3")],
)
def test_a_taken_name_gets_the_first_free_number(taken: set[str], suffix: str) -> None:
    assert unique_name("PROBE", taken) == "PROBE" + suffix


def test_a_long_name_is_cut_so_that_its_number_fits() -> None:
    assert unique_name(70 * "A", set()) == 63 * "A"
    assert unique_name(70 * "A", {63 * "A"}) == 61 * "A" + "_2"
    assert unique_name("ABCDE", {"ABCDE"}, max_length=5) == "ABC_2"
