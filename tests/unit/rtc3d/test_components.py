"""The five components of §7.3 to §7.7: their names, and their bytes as in vectors written by hand."""

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
from tests.unit.rtc3d.wire import both_orders, each_component, frame, only_component
from tests.vectors import ANALOG, FULL_FRAME, MARKERS, SHORT_EVENTS, TOOLS, ByteOrder, ComponentVector

Array = npt.NDArray[Any]


def values_of(items: Array, field: str) -> Array:
    return items if items.dtype.names is None else items[field]


def items_of(vector: ComponentVector) -> Array:
    """Return the vector's items as an array; each value is in the field of its name."""
    dtype = SHORT_EVENT if vector is SHORT_EVENTS else ITEM_DTYPES[ComponentType(vector.type)]
    items = np.zeros(vector.num_items, dtype)
    for field, values in vector.fields.items():
        values_of(items, field)[:] = values
    return items


def test_types_have_the_numbers_names_and_words_of_the_specification() -> None:
    """Clients and servers use the numbers in frames and the words in commands."""
    assert [(kind.value, kind.key, kind.command_word) for kind in WIRE_ORDER] == [
        (1, "3d", "3D"),
        (4, "6d", "6D"),
        (2, "analog", "Analog"),
        (3, "force", "Force"),
        (5, "event", "Events"),
    ]
    assert set(WIRE_ORDER) == set(ComponentType)
    assert {kind.key: kind for kind in ComponentType} == COMPONENTS_BY_KEY


@both_orders
@each_component
def test_each_component_is_split_as_documented(vector: ComponentVector, order: ByteOrder) -> None:
    """Every field of §7 is where the specification puts it, in both byte orders."""
    component = only_component(frame(order, vector.wire[order]), order)
    content = vector.wire[order][8:]
    assert component == (
        *(ComponentType(vector.type), vector.frame_number, vector.timestamp_us),
        *(vector.num_items, vector.item_bytes, order, content),
    )
    assert big_endian_content(component) == vector.wire["big"][8:]
    items = component.items()
    assert (items.shape, items.dtype.itemsize) == ((vector.num_items,), vector.item_bytes)
    assert items.dtype.names == (None if vector is ANALOG else tuple(vector.fields))
    for field, expected in vector.fields.items():
        values = values_of(items, field)
        np.testing.assert_array_equal(values, np.array(expected, values.dtype))


@both_orders
@each_component
def test_each_component_is_encoded_as_documented(vector: ComponentVector, order: ByteOrder) -> None:
    """Items in any byte order, contiguous or not, become the bytes of the specification."""
    items = items_of(vector)
    head = (ComponentType(vector.type), vector.frame_number, vector.timestamp_us)
    little = items.astype(items.dtype.newbyteorder("little"))
    for each in (items, little, np.repeat(items, 2)[::2]):
        assert encode_component(*head, each, order) == vector.wire[order]


def test_the_default_byte_order_is_big_endian() -> None:
    """§4.3: without SetByteOrder, frames are big-endian."""
    built = encode_component(
        ComponentType.MARKERS, MARKERS.frame_number, MARKERS.timestamp_us, items_of(MARKERS)
    )
    assert built == MARKERS.wire["big"]
    assert encode_frame([built]) == frame("big", MARKERS.wire["big"])


@both_orders
def test_missing_markers_and_tools_keep_all_their_bits(order: ByteOrder) -> None:
    """Subscribers recognise what is out of view by exactly these bits (§7.3, field note 7)."""
    present, missing = only_component(frame(order, MARKERS.wire[order]), order).items()
    assert not any(np.isnan(present[field]) for field in ("x", "y", "z"))
    assert {missing[field].tobytes() for field in ("x", "y", "z")} == {MISSING.tobytes()} == {b"\xff" * 4}
    assert missing["reliability"] == MISSING_RELIABILITY == 999.0
    visible, out_of_view = only_component(frame(order, TOOLS.wire[order]), order).items()
    assert not any(np.isnan(value) for value in visible.tolist())
    assert out_of_view.tobytes() == b"\xff" * 32


@both_orders
@pytest.mark.parametrize("kind", ComponentType)
def test_a_component_without_items_is_encoded_and_split(kind: ComponentType, order: ByteOrder) -> None:
    """A server sends them for what it does not measure at the moment."""
    wire = encode_component(kind, -1, -1, np.empty(0, ITEM_DTYPES[kind]), order)
    size, number = (24).to_bytes(4, order), int(kind).to_bytes(4, order)
    assert wire == size + number + b"\xff" * 12 + b"\0\0\0\0"
    component = only_component(frame(order, wire), order)
    assert (component.frame_number, component.timestamp_us, component.num_items) == (-1, -1, 0)
    assert component.items().shape == (0,)


def test_nothing_is_copied_to_read_items() -> None:
    """Copies of every frame would cost more than everything else that the gateway does."""
    for component in split_frame(FULL_FRAME["big"], "big").components:
        items = component.items()
        assert np.shares_memory(items, np.frombuffer(component.content, np.uint8))
        assert big_endian_content(component) is component.content
        with pytest.raises(ValueError, match="read-only"):
            items[0] = items[0]
