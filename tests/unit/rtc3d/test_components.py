from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from gateway.rtc3d.components import (
    BY_KEY,
    ITEM_DTYPES,
    LONG_EVENT,
    MISSING,
    MISSING_RELIABILITY,
    SHORT_EVENT,
    WIRE_ORDER,
    Component,
    ComponentType,
    big_endian_content,
    build_component,
    build_frame,
    byte_order_of,
    split_frame,
)
from tests.vectors import (
    ANALOG,
    COMPONENTS,
    EMPTY_FRAME,
    FRAME_WITH_UNKNOWN,
    FULL_FRAME,
    FULL_FRAME_COMPONENTS,
    LONG_EVENTS,
    MARKERS,
    SHORT_EVENTS,
    START_RECORDING,
    STOP_RECORDING,
    TOOLS,
    ByteOrder,
    ComponentVector,
)

Array = npt.NDArray[Any]

each_component = pytest.mark.parametrize("vector", COMPONENTS, ids=[vector.name for vector in COMPONENTS])
both_orders = pytest.mark.parametrize("order", ["big", "little"])


def frame(order: ByteOrder, *components: bytes) -> bytes:
    return len(components).to_bytes(4, order) + b"".join(components)


def only_component(body: bytes, order: ByteOrder) -> Component:
    (component,) = split_frame(body, order).components
    return component


def values_of(items: Array, field: str) -> Array:
    return items if items.dtype.names is None else items[field]


def items_of(vector: ComponentVector) -> Array:
    """Return the vector's items as an array, each value put at its field's name."""
    dtype = SHORT_EVENT if vector is SHORT_EVENTS else ITEM_DTYPES[ComponentType(vector.type)]
    items = np.zeros(vector.num_items, dtype)
    for field, values in vector.fields.items():
        values_of(items, field)[:] = values
    return items


def memory_of(data: bytes | memoryview) -> npt.NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8)


# What the specification and the field notes fix ----------------------------------------------


def test_types_are_numbered_and_named_as_documented() -> None:
    assert {kind.key: kind.value for kind in ComponentType} == {
        "3d": 1,
        "analog": 2,
        "force": 3,
        "6d": 4,
        "event": 5,
    }
    assert {key: kind.value for key, kind in BY_KEY.items()} == {
        "3d": 1,
        "analog": 2,
        "force": 3,
        "6d": 4,
        "event": 5,
    }


def test_wire_order_is_3d_6d_analog_force_event() -> None:
    assert [kind.value for kind in WIRE_ORDER] == [1, 4, 2, 3, 5]


def test_missing_has_all_bits_set() -> None:
    assert np.asarray(MISSING).tobytes() == b"\xff\xff\xff\xff"
    assert MISSING_RELIABILITY == 999.0


# Vectors both ways ---------------------------------------------------------------------------


@both_orders
@each_component
def test_splits_each_component_as_documented(vector: ComponentVector, order: ByteOrder) -> None:
    component = only_component(frame(order, vector.wire[order]), order)
    assert component.type is ComponentType(vector.type)
    assert component.frame_number == vector.frame_number
    assert component.timestamp_us == vector.timestamp_us
    assert component.num_items == vector.num_items
    assert component.item_bytes == vector.item_bytes
    assert component.byte_order == order
    assert bytes(component.content) == vector.wire[order][8:]


@both_orders
@each_component
def test_reads_the_items_of_each_component_as_documented(vector: ComponentVector, order: ByteOrder) -> None:
    items = only_component(frame(order, vector.wire[order]), order).items()
    assert items.shape == (vector.num_items,)
    assert items.dtype.itemsize == vector.item_bytes
    assert items.dtype.names == (None if vector is ANALOG else tuple(vector.fields))
    for field, expected in vector.fields.items():
        values = values_of(items, field)
        np.testing.assert_array_equal(values, np.array(expected, values.dtype))


@both_orders
@each_component
def test_builds_each_component_as_documented(vector: ComponentVector, order: ByteOrder) -> None:
    kind = ComponentType(vector.type)
    items = items_of(vector)
    built = build_component(kind, vector.frame_number, vector.timestamp_us, items, order)
    assert built == vector.wire[order]


@both_orders
@pytest.mark.parametrize("items_order", ["big", "little"])
@each_component
def test_builds_from_items_in_any_byte_order(
    vector: ComponentVector, items_order: ByteOrder, order: ByteOrder
) -> None:
    items = items_of(vector)
    items = items.astype(items.dtype.newbyteorder(items_order))
    built = build_component(
        ComponentType(vector.type), vector.frame_number, vector.timestamp_us, items, order
    )
    assert built == vector.wire[order]


@both_orders
@each_component
def test_builds_from_items_that_are_not_contiguous(vector: ComponentVector, order: ByteOrder) -> None:
    items = np.repeat(items_of(vector), 2)[::2]
    kind = ComponentType(vector.type)
    built = build_component(kind, vector.frame_number, vector.timestamp_us, items, order)
    assert built == vector.wire[order]


def test_builds_big_endian_unless_told_otherwise() -> None:
    kind = ComponentType(MARKERS.type)
    built = build_component(kind, MARKERS.frame_number, MARKERS.timestamp_us, items_of(MARKERS))
    assert built == MARKERS.wire["big"]
    assert build_frame([built]) == frame("big", MARKERS.wire["big"])


@both_orders
@each_component
def test_big_endian_content_is_that_of_the_big_endian_vector(
    vector: ComponentVector, order: ByteOrder
) -> None:
    component = only_component(frame(order, vector.wire[order]), order)
    assert bytes(big_endian_content(component)) == vector.wire["big"][8:]


@both_orders
def test_a_missing_marker_keeps_its_bits_and_its_reliability(order: ByteOrder) -> None:
    present, missing = only_component(frame(order, MARKERS.wire[order]), order).items()
    assert not any(np.isnan(present[field]) for field in ("x", "y", "z"))
    for field in ("x", "y", "z"):
        assert np.isnan(missing[field])
        assert missing[field].tobytes() == b"\xff\xff\xff\xff"
    assert missing["reliability"] == 999.0


@both_orders
def test_a_tool_out_of_view_is_all_ones(order: ByteOrder) -> None:
    visible, out_of_view = only_component(frame(order, TOOLS.wire[order]), order).items()
    assert not any(np.isnan(value) for value in visible.tolist())
    assert out_of_view.tobytes() == b"\xff" * 32


@both_orders
@pytest.mark.parametrize("kind", ComponentType)
def test_a_component_without_items_is_built_and_split(kind: ComponentType, order: ByteOrder) -> None:
    wire = build_component(kind, -1, -1, np.empty(0, ITEM_DTYPES[kind]), order)
    size, number = (24).to_bytes(4, order), int(kind).to_bytes(4, order)
    assert wire == size + number + b"\xff" * 12 + b"\0\0\0\0"
    component = only_component(frame(order, wire), order)
    assert (component.frame_number, component.timestamp_us, component.num_items) == (-1, -1, 0)
    assert component.items().shape == (0,)
    assert bytes(big_endian_content(component)) == b"\xff" * 12 + b"\0\0\0\0"


# No copies -----------------------------------------------------------------------------------


@both_orders
@each_component
def test_content_and_items_are_views_of_the_body(vector: ComponentVector, order: ByteOrder) -> None:
    body = frame(order, MARKERS.wire[order], vector.wire[order], ANALOG.wire[order])
    _, component, _ = split_frame(body, order).components
    assert np.shares_memory(memory_of(component.content), memory_of(body))
    assert np.shares_memory(component.items(), memory_of(body))


@both_orders
def test_items_cannot_be_written(order: ByteOrder) -> None:
    items = only_component(frame(order, ANALOG.wire[order]), order).items()
    with pytest.raises(ValueError, match="read-only"):
        items[0] = 1.0


def test_big_endian_content_of_a_big_endian_component_is_not_copied() -> None:
    body = FULL_FRAME["big"]
    for component in split_frame(body, "big").components:
        assert np.shares_memory(memory_of(big_endian_content(component)), memory_of(body))


# Frames --------------------------------------------------------------------------------------


@both_orders
def test_splits_a_frame_of_all_five_components(order: ByteOrder) -> None:
    split = split_frame(FULL_FRAME[order], order)
    assert [component.type.key for component in split.components] == ["3d", "6d", "analog", "force", "event"]
    assert [bytes(component.content) for component in split.components] == [
        vector.wire[order][8:] for vector in FULL_FRAME_COMPONENTS
    ]
    assert split.unknown_types == ()


@both_orders
def test_builds_a_frame_of_all_five_components(order: ByteOrder) -> None:
    parts = (vector.wire[order] for vector in FULL_FRAME_COMPONENTS)
    assert build_frame(parts, order) == FULL_FRAME[order]


@both_orders
def test_an_empty_frame_has_no_components(order: ByteOrder) -> None:
    assert split_frame(EMPTY_FRAME[order], order) == ((), ())
    assert build_frame([], order) == EMPTY_FRAME[order]


@both_orders
def test_an_unknown_component_is_skipped_and_named(order: ByteOrder) -> None:
    split = split_frame(FRAME_WITH_UNKNOWN[order], order)
    assert [bytes(component.content) for component in split.components] == [
        MARKERS.wire[order][8:],
        ANALOG.wire[order][8:],
    ]
    assert split.unknown_types == (9,)


@both_orders
@pytest.mark.parametrize("data_bytes", [0, 1, 12, 15, 16, 17])
def test_an_unknown_component_may_be_of_any_size(data_bytes: int, order: ByteOrder) -> None:
    unknown = (8 + data_bytes).to_bytes(4, order) + (0).to_bytes(4, order) + bytes(data_bytes)
    assert split_frame(frame(order, unknown), order) == ((), (0,))
    split = split_frame(frame(order, unknown, ANALOG.wire[order], unknown), order)
    assert [component.type.key for component in split.components] == ["analog"]
    assert split.unknown_types == (0, 0)


@both_orders
def test_events_of_16_and_of_24_bytes_may_stand_in_one_frame(order: ByteOrder) -> None:
    body = frame(order, SHORT_EVENTS.wire[order], LONG_EVENTS.wire[order])
    short, long = split_frame(body, order).components
    assert (short.item_bytes, long.item_bytes) == (16, 24)
    assert short.items().dtype.names == SHORT_EVENT.names
    assert long.items().dtype.names == LONG_EVENT.names
    assert short.items()["param1"].tolist() == long.items()["param1"].tolist() == [7, 1065353216]


@pytest.mark.parametrize(
    ("packet", "order", "event_id"),
    [(START_RECORDING, "little", 1), (STOP_RECORDING, "big", 0)],
    ids=["start", "stop"],
)
def test_reads_the_frame_that_controls_wavefronts_recording(
    packet: bytes, order: ByteOrder, event_id: int
) -> None:
    body = packet[8:]
    assert byte_order_of(body, "big") == order
    component = only_component(body, order)
    assert component.type is ComponentType.EVENT
    assert component.frame_number == -1
    assert component.item_bytes == 24
    assert component.items().tolist() == [(event_id, 0, -1, -1, -1)]

    events = np.array([(event_id, 0, -1, -1, -1)], LONG_EVENT)
    assert build_frame([build_component(ComponentType.EVENT, -1, 0, events, order)], order) == body
