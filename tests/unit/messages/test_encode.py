import struct
from typing import Any

import numpy as np
import pytest
import rtc3d

from gateway.messages.encode import CONTENT_OFFSET, ITEMS_OFFSET, MESSAGE_TYPES, encode_message, lcm_type_name
from gateway.messages.stamp import Stamp
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import split_frame
from tests.unit.messages.samples import received
from tests.vectors import (
    ANALOG,
    COMPONENTS,
    FORCE,
    LONG_EVENTS,
    MARKERS,
    SHORT_EVENTS,
    TOOLS,
    ByteOrder,
    ComponentVector,
)

STAMP = Stamp(
    utime=1_700_000_000_000_001, capture_utime=1_700_000_000_000_000, session=3, parameters_version=5
)
SEQUENCE = 41
# fingerprint, utime, capture_utime, sequence, session, parameters version, frame number, time stamp, count
HEADER = struct.Struct(">8sqqqiiiqi")

LCM_TYPES: dict[int, type[Any]] = {
    1: rtc3d.markers_t,
    2: rtc3d.analog_t,
    3: rtc3d.forces_t,
    4: rtc3d.tools_t,
    5: rtc3d.events_t,
}
COUNTS = {1: "num_markers", 2: "num_channels", 3: "num_plates", 4: "num_tools", 5: "num_events"}
ITEMS = {1: "markers", 2: "voltages", 3: "plates", 4: "tools", 5: "events"}

each_component = pytest.mark.parametrize("vector", COMPONENTS, ids=[vector.name for vector in COMPONENTS])
both_orders = pytest.mark.parametrize("order", ["big", "little"])


def header_of(vector: ComponentVector) -> bytes:
    return HEADER.pack(
        LCM_TYPES[vector.type]._get_packed_fingerprint(),
        1_700_000_000_000_001, 1_700_000_000_000_000, 41, 3, 5,
        vector.frame_number, vector.timestamp_us, vector.num_items,
    )  # fmt: skip


@both_orders
@pytest.mark.parametrize("vector", [MARKERS, ANALOG, FORCE, TOOLS, LONG_EVENTS])
def test_a_message_is_fingerprint_prefix_and_big_endian_component(
    vector: ComponentVector, order: ByteOrder
) -> None:
    assert (
        encode_message(received(vector, order), STAMP, SEQUENCE)
        == header_of(vector) + vector.wire["big"][24:]
    )


def test_every_byte_of_a_markers_message_is_as_documented() -> None:
    missing = b"\xff\xff\xff\xff"
    assert encode_message(received(MARKERS), STAMP, SEQUENCE) == (
        rtc3d.markers_t._get_packed_fingerprint()
        + struct.pack(">q", 1_700_000_000_000_001)
        + struct.pack(">q", 1_700_000_000_000_000)
        + struct.pack(">q", 41)
        + struct.pack(">i", 3)
        + struct.pack(">i", 5)
        + struct.pack(">iqi", 16909060, 4328719365, 2)
        + struct.pack(">4f", 1.0, -2.5, 1000.25, 0.5)
        + missing + missing + missing + struct.pack(">f", 999.0)
    )  # fmt: skip


@both_orders
def test_events_of_16_bytes_get_the_time_stamp_of_their_component(order: ByteOrder) -> None:
    assert encode_message(received(SHORT_EVENTS, order), STAMP, SEQUENCE) == (
        header_of(SHORT_EVENTS)
        + struct.pack(">iqiii", 0x123456, 10000, 7, 1, -1)
        + struct.pack(">iqiii", 2, 10000, 1065353216, -1, -1)
    )


@both_orders
@each_component
def test_lcm_gen_decodes_every_field(vector: ComponentVector, order: ByteOrder) -> None:
    message = LCM_TYPES[vector.type].decode(encode_message(received(vector, order), STAMP, SEQUENCE))
    prefix = (
        message.utime,
        message.capture_utime,
        message.sequence,
        message.session,
        message.parameters_version,
    )
    assert prefix == (STAMP.utime, STAMP.capture_utime, SEQUENCE, STAMP.session, STAMP.parameters_version)
    assert (message.frame_number, message.timestamp) == (vector.frame_number, vector.timestamp_us)
    assert getattr(message, COUNTS[vector.type]) == vector.num_items
    items: list[Any] = list(getattr(message, ITEMS[vector.type]))
    dtype = np.int64 if vector.type == 5 else np.float32
    for field, values in vector.fields.items():
        decoded = items if vector is ANALOG else [getattr(item, field) for item in items]
        np.testing.assert_array_equal(np.array(decoded, dtype), np.array(values, dtype))
    if vector is SHORT_EVENTS:
        assert [event.timestamp for event in items] == [vector.timestamp_us] * 2


@both_orders
@each_component
def test_lcm_gen_encodes_what_it_decoded_to_the_same_bytes(vector: ComponentVector, order: ByteOrder) -> None:
    message = encode_message(received(vector, order), STAMP, SEQUENCE)
    assert LCM_TYPES[vector.type].decode(message).encode() == message


@both_orders
@pytest.mark.parametrize("kind", list(ComponentType), ids=lambda kind: kind.key)
def test_a_component_without_items_gives_a_message_without_items(
    kind: ComponentType, order: ByteOrder
) -> None:
    wire = b"".join(
        number.to_bytes(width, order) for number, width in ((24, 4), (kind, 4), (7, 4), (9, 8), (0, 4))
    )
    (component,) = split_frame((1).to_bytes(4, order) + wire, order).components
    fingerprint = LCM_TYPES[kind]._get_packed_fingerprint()
    expected = struct.pack(
        ">8sqqqiiiqi", fingerprint, STAMP.utime, STAMP.capture_utime, SEQUENCE, STAMP.session, 5, 7, 9, 0
    )
    assert encode_message(component, STAMP, SEQUENCE) == expected


def test_content_and_items_begin_at_the_documented_offsets() -> None:
    message = encode_message(received(ANALOG), STAMP, SEQUENCE)
    assert (CONTENT_OFFSET, ITEMS_OFFSET) == (40, HEADER.size) == (40, 56)
    assert message[CONTENT_OFFSET:ITEMS_OFFSET] == ANALOG.wire["big"][8:24]
    assert message[ITEMS_OFFSET:] == ANALOG.wire["big"][24:]


def test_each_component_has_its_own_lcm_type() -> None:
    assert {kind.key: lcm_type_name(message_type) for kind, message_type in MESSAGE_TYPES.items()} == {
        "3d": "rtc3d.markers_t",
        "6d": "rtc3d.tools_t",
        "analog": "rtc3d.analog_t",
        "force": "rtc3d.forces_t",
        "event": "rtc3d.events_t",
    }
