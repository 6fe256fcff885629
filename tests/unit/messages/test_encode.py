"""LCM messages of components: fingerprint, prefix and content. tests/vectors.py has the components."""

import struct

import pytest
import rtc3d

from gateway.messages.encode import (
    CONTENT_OFFSET,
    ITEMS_OFFSET,
    MESSAGE_TYPES,
    encode_message,
    lcm_type_name,
    message_timestamp_us,
    with_sequence,
)
from gateway.messages.limits import encode_within_limits
from gateway.messages.stamp import Stamp
from gateway.rtc3d.components import ComponentType
from tests.unit.messages.samples import received
from tests.vectors import ANALOG, FORCE, LONG_EVENTS, MARKERS, SHORT_EVENTS, TOOLS, ByteOrder, ComponentVector

STAMP = Stamp(1_700_000_000_000_001, 1_700_000_000_000_000, session=3, parameters_version=5)
SEQUENCE = 41
ORDERS: tuple[ByteOrder, ByteOrder] = ("big", "little")


def header_of(vector: ComponentVector) -> bytes:
    """Return fingerprint, prefix, frame number, time stamp and number of items, made with struct alone."""
    fingerprint: bytes = MESSAGE_TYPES[ComponentType(vector.type)]._get_packed_fingerprint()
    prefix = struct.pack(">qqqii", 1_700_000_000_000_001, 1_700_000_000_000_000, 41, 3, 5)
    return (
        fingerprint + prefix + struct.pack(">iqi", vector.frame_number, vector.timestamp_us, vector.num_items)
    )


@pytest.mark.parametrize("vector", [MARKERS, ANALOG, FORCE, TOOLS, LONG_EVENTS], ids=lambda each: each.name)
def test_a_message_is_fingerprint_prefix_and_big_endian_component(vector: ComponentVector) -> None:
    """Subscribers in other languages read these bytes; test_vectors.py has them for all types."""
    for order in ORDERS:
        message = encode_message(received(vector, order), STAMP, SEQUENCE)
        assert message == header_of(vector) + vector.wire["big"][24:]
        assert message[CONTENT_OFFSET:] == vector.wire["big"][8:]
        assert message[ITEMS_OFFSET:] == vector.wire["big"][24:]


def test_events_of_16_bytes_get_the_time_stamp_of_their_component() -> None:
    """Field note 6: subscribers get one form, whichever the server sends."""
    for order in ORDERS:
        assert encode_message(received(SHORT_EVENTS, order), STAMP, SEQUENCE) == (
            header_of(SHORT_EVENTS)
            + struct.pack(">iqiii", 0x123456, 10000, 7, 1, -1)
            + struct.pack(">iqiii", 2, 10000, 1065353216, -1, -1)
        )


def test_another_sequence_number_changes_nothing_else() -> None:
    """A reply to a query has the content of the newest sample, and its time stamp is found in place."""
    message = encode_message(received(MARKERS), STAMP, SEQUENCE)
    assert with_sequence(message, -1) == encode_message(received(MARKERS), STAMP, -1)
    assert message_timestamp_us(message) == MARKERS.timestamp_us


def test_names_of_lcm_types() -> None:
    """They are the encoding of Zenoh samples."""
    names = {component.key: lcm_type_name(lcm_type) for component, lcm_type in MESSAGE_TYPES.items()}
    assert names == {
        "3d": "rtc3d.markers_t",
        "6d": "rtc3d.tools_t",
        "analog": "rtc3d.analog_t",
        "force": "rtc3d.forces_t",
        "event": "rtc3d.events_t",
    }


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
