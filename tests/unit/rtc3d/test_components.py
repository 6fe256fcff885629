from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from gateway.rtc3d.components import (
    COMPONENTS_BY_KEY,
    ITEM_DTYPES,
    MISSING,
    MISSING_RELIABILITY,
    SHORT_EVENT,
    WIRE_ORDER,
    ComponentType,
    big_endian_content,
    encode_component,
)
from gateway.rtc3d.frames import encode_frame, split_frame
from tests.unit.rtc3d.wire import frame, only_component
from tests.vectors import (
    ANALOG,
    COMPONENTS,
    FULL_FRAME,
    MARKERS,
    SHORT_EVENTS,
    TOOLS,
    ByteOrder,
    ComponentVector,
)

Array = npt.NDArray[Any]

each_component = pytest.mark.parametrize("vector", COMPONENTS, ids=[vector.name for vector in COMPONENTS])
both_orders = pytest.mark.parametrize("order", ["big", "little"])


def values_of(items: Array, field: str) -> Array:
    return items if items.dtype.names is None else items[field]


def items_of(vector: ComponentVector) -> Array:
    """Return the vector's items as an array; each value is in the field of its name."""
    dtype = SHORT_EVENT if vector is SHORT_EVENTS else ITEM_DTYPES[ComponentType(vector.type)]
    items = np.zeros(vector.num_items, dtype)
    for field, values in vector.fields.items():
        values_of(items, field)[:] = values
    return items


def memory_of(data: bytes | memoryview) -> npt.NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8)


# Constants of the specification and the field notes -------------------------------------------


def test_types_are_numbered_and_named_as_documented() -> None:
    assert {kind.key: kind.value for kind in ComponentType} == {
        "3d": 1,
        "analog": 2,
        "force": 3,
        "6d": 4,
        "event": 5,
    }
    assert {key: kind.value for key, kind in COMPONENTS_BY_KEY.items()} == {
        "3d": 1,
        "analog": 2,
        "force": 3,
        "6d": 4,
        "event": 5,
    }


def test_components_have_the_names_of_section_5_3_5_in_commands() -> None:
    words = {kind.value: kind.command_word for kind in ComponentType}
    assert words == {1: "3D", 2: "Analog", 3: "Force", 4: "6D", 5: "Events"}


def test_wire_order_is_3d_6d_analog_force_event() -> None:
    assert [kind.value for kind in WIRE_ORDER] == [1, 4, 2, 3, 5]


def test_a_missing_value_has_all_bits_set() -> None:
    assert np.asarray(MISSING).tobytes() == b"\xff\xff\xff\xff"
    assert MISSING_RELIABILITY == 999.0


# Encoding and splitting the vectors -----------------------------------------------------------


@both_orders
@each_component
def test_each_component_is_split_as_documented(vector: ComponentVector, order: ByteOrder) -> None:
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
def test_the_items_of_each_component_are_as_documented(vector: ComponentVector, order: ByteOrder) -> None:
    items = only_component(frame(order, vector.wire[order]), order).items()
    assert items.shape == (vector.num_items,)
    assert items.dtype.itemsize == vector.item_bytes
    assert items.dtype.names == (None if vector is ANALOG else tuple(vector.fields))
    for field, expected in vector.fields.items():
        values = values_of(items, field)
        np.testing.assert_array_equal(values, np.array(expected, values.dtype))


@both_orders
@each_component
def test_each_component_is_encoded_as_documented(vector: ComponentVector, order: ByteOrder) -> None:
    kind = ComponentType(vector.type)
    items = items_of(vector)
    built = encode_component(kind, vector.frame_number, vector.timestamp_us, items, order)
    assert built == vector.wire[order]


@both_orders
@pytest.mark.parametrize("items_order", ["big", "little"])
@each_component
def test_items_in_any_byte_order_are_encoded(
    vector: ComponentVector, items_order: ByteOrder, order: ByteOrder
) -> None:
    items = items_of(vector)
    items = items.astype(items.dtype.newbyteorder(items_order))
    built = encode_component(
        ComponentType(vector.type), vector.frame_number, vector.timestamp_us, items, order
    )
    assert built == vector.wire[order]


@both_orders
@each_component
def test_items_that_are_not_contiguous_are_encoded(vector: ComponentVector, order: ByteOrder) -> None:
    items = np.repeat(items_of(vector), 2)[::2]
    kind = ComponentType(vector.type)
    built = encode_component(kind, vector.frame_number, vector.timestamp_us, items, order)
    assert built == vector.wire[order]


def test_the_default_byte_order_is_big_endian() -> None:
    kind = ComponentType(MARKERS.type)
    built = encode_component(kind, MARKERS.frame_number, MARKERS.timestamp_us, items_of(MARKERS))
    assert built == MARKERS.wire["big"]
    assert encode_frame([built]) == frame("big", MARKERS.wire["big"])


@both_orders
@each_component
def test_big_endian_content_equals_the_big_endian_vector(vector: ComponentVector, order: ByteOrder) -> None:
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
def test_a_component_without_items_is_encoded_and_split(kind: ComponentType, order: ByteOrder) -> None:
    wire = encode_component(kind, -1, -1, np.empty(0, ITEM_DTYPES[kind]), order)
    size, number = (24).to_bytes(4, order), int(kind).to_bytes(4, order)
    assert wire == size + number + b"\xff" * 12 + b"\0\0\0\0"
    component = only_component(frame(order, wire), order)
    assert (component.frame_number, component.timestamp_us, component.num_items) == (-1, -1, 0)
    assert component.items().shape == (0,)
    assert bytes(big_endian_content(component)) == b"\xff" * 12 + b"\0\0\0\0"


# Items ----------------------------------------------------------------------------------------


@both_orders
@each_component
def test_items_share_memory_with_the_content(vector: ComponentVector, order: ByteOrder) -> None:
    body = frame(order, MARKERS.wire[order], vector.wire[order], ANALOG.wire[order])
    _, component, _ = split_frame(body, order).components
    assert np.shares_memory(component.items(), memory_of(component.content))


@both_orders
def test_items_are_read_only(order: ByteOrder) -> None:
    items = only_component(frame(order, ANALOG.wire[order]), order).items()
    with pytest.raises(ValueError, match="read-only"):
        items[0] = 1.0


def test_big_endian_content_of_a_big_endian_component_is_not_copied() -> None:
    for component in split_frame(FULL_FRAME["big"], "big").components:
        assert big_endian_content(component) is component.content
