import math
import struct
from itertools import chain
from typing import Any

import numpy as np
import pytest
import rtc3d

from gateway.messages.splice import (
    MESSAGE_HEADER_BYTES,
    MESSAGE_TYPES,
    Stamp,
    message_items,
    metres_per_unit,
    splice,
    tool_poses,
    type_name,
)
from gateway.rtc3d.components import ITEM_DTYPES, Component, ComponentType
from gateway.rtc3d.frames import split_frame
from tests.vectors import (
    ALL_ONES,
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

STAMP = Stamp(utime=1_700_000_000_000_001, capture_utime=1_700_000_000_000_000, session=3)
SEQUENCE = 41
# fingerprint, utime, capture_utime, sequence, session, frame number, time stamp, count
HEADER = struct.Struct(">8sqqqiiqi")
POSE = struct.Struct(">8sqqqiiqb8f")

LCM_TYPES: dict[int, type[Any]] = {
    1: rtc3d.markers_t,
    2: rtc3d.analog_t,
    3: rtc3d.forces_t,
    4: rtc3d.tools_t,
    5: rtc3d.events_t,
}
COUNTS = {1: "num_markers", 2: "num_channels", 3: "num_plates", 4: "num_tools", 5: "num_events"}
ITEMS = {1: "markers", 2: "voltages", 3: "plates", 4: "tools", 5: "events"}
NAN = math.nan

each_component = pytest.mark.parametrize("vector", COMPONENTS, ids=[vector.name for vector in COMPONENTS])
both_orders = pytest.mark.parametrize("order", ["big", "little"])


def received(vector: ComponentVector, order: ByteOrder = "big") -> Component:
    (component,) = split_frame((1).to_bytes(4, order) + vector.wire[order], order).components
    return component


def header_of(vector: ComponentVector) -> bytes:
    return HEADER.pack(
        LCM_TYPES[vector.type]._get_packed_fingerprint(),
        1_700_000_000_000_001, 1_700_000_000_000_000, 41, 3,
        vector.frame_number, vector.timestamp_us, vector.num_items,
    )  # fmt: skip


# Component messages --------------------------------------------------------------------------


@both_orders
@pytest.mark.parametrize("vector", [MARKERS, ANALOG, FORCE, TOOLS, LONG_EVENTS])
def test_a_message_is_fingerprint_prefix_and_the_big_endian_component(
    vector: ComponentVector, order: ByteOrder
) -> None:
    assert splice(received(vector, order), STAMP, SEQUENCE) == header_of(vector) + vector.wire["big"][24:]


def test_a_message_of_markers_byte_by_byte() -> None:
    missing = b"\xff\xff\xff\xff"
    assert splice(received(MARKERS), STAMP, SEQUENCE) == (
        rtc3d.markers_t._get_packed_fingerprint()
        + struct.pack(">q", 1_700_000_000_000_001)
        + struct.pack(">q", 1_700_000_000_000_000)
        + struct.pack(">q", 41)
        + struct.pack(">i", 3)
        + struct.pack(">iqi", 16909060, 4328719365, 2)
        + struct.pack(">4f", 1.0, -2.5, 1000.25, 0.5)
        + missing + missing + missing + struct.pack(">f", 999.0)
    )  # fmt: skip


@both_orders
def test_events_of_16_bytes_get_the_components_time_stamp(order: ByteOrder) -> None:
    assert splice(received(SHORT_EVENTS, order), STAMP, SEQUENCE) == (
        header_of(SHORT_EVENTS)
        + struct.pack(">iqiii", 0x123456, 10000, 7, 1, -1)
        + struct.pack(">iqiii", 2, 10000, 1065353216, -1, -1)
    )


@both_orders
@each_component
def test_lcm_gens_types_decode_every_field(vector: ComponentVector, order: ByteOrder) -> None:
    message = LCM_TYPES[vector.type].decode(splice(received(vector, order), STAMP, SEQUENCE))
    prefix = (message.utime, message.capture_utime, message.sequence, message.session)
    assert prefix == (STAMP.utime, STAMP.capture_utime, SEQUENCE, STAMP.session)
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
def test_what_lcm_gen_decodes_it_encodes_to_the_same_bytes(vector: ComponentVector, order: ByteOrder) -> None:
    message = splice(received(vector, order), STAMP, SEQUENCE)
    assert LCM_TYPES[vector.type].decode(message).encode() == message


@both_orders
@pytest.mark.parametrize("kind", list(ComponentType), ids=lambda kind: kind.key)
def test_a_component_without_items_is_a_message_without_items(kind: ComponentType, order: ByteOrder) -> None:
    wire = b"".join(
        number.to_bytes(width, order) for number, width in ((24, 4), (kind, 4), (7, 4), (9, 8), (0, 4))
    )
    (component,) = split_frame((1).to_bytes(4, order) + wire, order).components
    fingerprint = LCM_TYPES[kind]._get_packed_fingerprint()
    expected = struct.pack(
        ">8sqqqiiqi", fingerprint, STAMP.utime, STAMP.capture_utime, SEQUENCE, STAMP.session, 7, 9, 0
    )
    assert splice(component, STAMP, SEQUENCE) == expected


def test_the_items_begin_where_documented() -> None:
    message = splice(received(ANALOG), STAMP, SEQUENCE)
    assert MESSAGE_HEADER_BYTES == HEADER.size == 52
    assert message[MESSAGE_HEADER_BYTES:] == ANALOG.wire["big"][24:]


def test_each_component_has_its_type() -> None:
    assert {kind.key: type_name(message_type) for kind, message_type in MESSAGE_TYPES.items()} == {
        "3d": "rtc3d.markers_t",
        "6d": "rtc3d.tools_t",
        "analog": "rtc3d.analog_t",
        "force": "rtc3d.forces_t",
        "event": "rtc3d.events_t",
    }


@each_component
def test_a_messages_items_are_a_view_of_it(vector: ComponentVector) -> None:
    kind = ComponentType(vector.type)
    message = splice(received(vector, "little"), STAMP, SEQUENCE)
    items = message_items(message, kind)
    assert items.shape == (vector.num_items,)
    assert items.dtype == ITEM_DTYPES[kind]
    assert not items.flags.writeable
    assert np.shares_memory(items.view(np.uint8), np.frombuffer(message, np.uint8))
    for field, values in vector.fields.items():
        column = items if vector is ANALOG else items[field]
        np.testing.assert_array_equal(column, np.array(values, column.dtype))


# Poses per tool ------------------------------------------------------------------------------


def tools(*poses: tuple[float, ...]) -> Component:
    """Return a 6D component: of each tool q0, qx, qy, qz, x, y, z, error."""
    wire = struct.pack(">IIiqI", 24 + 32 * len(poses), 4, 4, 7500, len(poses))
    wire += struct.pack(f">{8 * len(poses)}f", *chain.from_iterable(poses))
    (component,) = split_frame(struct.pack(">I", 1) + wire, "big").components
    return component


def pose_of(component: Component, metres: float = 1e-3) -> Any:
    [message] = tool_poses(component, STAMP, [SEQUENCE], metres)
    return rtc3d.tool_pose_t.decode(message)


@both_orders
def test_poses_are_in_metres_with_the_scalar_last(order: ByteOrder) -> None:
    fingerprint = rtc3d.tool_pose_t._get_packed_fingerprint()
    stamp = (1_700_000_000_000_001, 1_700_000_000_000_000)
    visible, missing = tool_poses(received(TOOLS, order), STAMP, [41, 7])
    assert visible == POSE.pack(
        fingerprint, *stamp, 41, 3, 4, 7500, 1,
        0.1, -0.2, 1.6,
        *struct.unpack(">4f", bytes.fromhex("BECCCCCD 3ECCCCCD 3E4CCCCD 3F4CCCCD")),
        0.000125,
    )  # fmt: skip
    assert missing == POSE.pack(fingerprint, *stamp, 7, 3, 4, 7500, 0, *8 * [NAN])


@both_orders
def test_lcm_gens_type_decodes_poses(order: ByteOrder) -> None:
    messages = tool_poses(received(TOOLS, order), STAMP, [41, 7])
    visible, missing = map(rtc3d.tool_pose_t.decode, messages)
    assert [each.encode() for each in (visible, missing)] == messages
    assert (visible.visible, missing.visible) == (True, False)
    assert visible.position_m == pytest.approx((0.1, -0.2, 1.6))
    assert visible.orientation_xyzw == pytest.approx((-0.4, 0.4, 0.2, 0.8))
    assert visible.error_m == pytest.approx(0.000125)
    numbers = (*missing.position_m, *missing.orientation_xyzw, missing.error_m)
    assert all(map(math.isnan, numbers))


@pytest.mark.parametrize("nan", [NAN, ALL_ONES])
@pytest.mark.parametrize("field", range(8))
def test_any_nan_makes_the_whole_pose_missing(field: int, nan: float) -> None:
    values = [1.0, 0.0, 0.0, 0.0, 100.0, 200.0, 300.0, 0.5]
    values[field] = nan
    pose = pose_of(tools(tuple(values)))
    assert not pose.visible
    assert all(map(math.isnan, (*pose.position_m, *pose.orientation_xyzw, pose.error_m)))


def test_zeros_are_a_pose() -> None:
    pose = pose_of(tools((0.0,) * 8))
    assert pose.visible
    assert (*pose.position_m, *pose.orientation_xyzw, pose.error_m) == (0.0,) * 8


def test_a_component_in_metres_stays_as_it_is() -> None:
    pose = pose_of(tools((1.0, 0.0, 0.0, 0.0, 1.5, -2.0, 0.25, 0.0625)), metres=1.0)
    assert (pose.position_m, pose.error_m) == ((1.5, -2.0, 0.25), 0.0625)


def test_no_tools_are_no_poses() -> None:
    assert tool_poses(tools(), STAMP, []) == []


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        ("mm", 0.001),
        (" MM ", 0.001),
        ("", 0.001),  # the default of §6.2
        ("m", 1.0),
        ("cm", 0.01),
        ("um", 1e-6),
        ("µm", 1e-6),
        ("in", 0.0254),
        ("furlong", None),
    ],
)
def test_units_of_length_are_known(unit: str, metres: float | None) -> None:
    assert metres_per_unit(unit) == metres
