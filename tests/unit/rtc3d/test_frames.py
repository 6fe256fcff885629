"""Data frames (§7): components as in vectors written by hand, contradictions, byte order and layouts."""

import re
import struct
import tracemalloc
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from gateway.errors import FrameError
from gateway.rtc3d.components import (
    COMPONENTS_BY_KEY,
    ITEM_DTYPES,
    SHORT_EVENT,
    WIRE_ORDER,
    Component,
    ComponentType,
    big_endian_content,
    encode_component,
)
from gateway.rtc3d.frames import (
    FrameReader,
    announced_components,
    detect_byte_order,
    encode_frame,
    split_frame,
)
from tests.support.errors import raises
from tests.support.vectors import (
    ANALOG,
    COMPONENTS,
    EMPTY_FRAME,
    FRAME_WITH_UNKNOWN,
    FULL_FRAME,
    FULL_FRAME_COMPONENTS,
    MARKERS,
    SHORT_EVENTS,
    UNKNOWN_COMPONENT,
    ByteOrder,
    ComponentVector,
)

Array = npt.NDArray[Any]
both_orders = pytest.mark.parametrize("order", ["big", "little"])
each_component = pytest.mark.parametrize("vector", COMPONENTS, ids=[vector.name for vector in COMPONENTS])


def frame(order: ByteOrder, *components: bytes, count: int | None = None) -> bytes:
    """Return a frame's bytes. ``count`` replaces its component count with a wrong one."""
    return (len(components) if count is None else count).to_bytes(4, order) + b"".join(components)


def only_component(body: bytes, order: ByteOrder) -> Component:
    (component,) = split_frame(body, order).components
    return component


def zeros(kind: ComponentType, count: int = 1) -> bytes:
    """Return a component whose items are zeros."""
    return encode_component(kind, 1, 1, np.zeros(count, ITEM_DTYPES[kind]))


def values_of(items: Array, field: str) -> Array:
    return items if items.dtype.names is None else items[field]


# Components -----------------------------------------------------------------------------------


def test_types_have_the_numbers_names_and_words_of_the_specification() -> None:
    """Clients and servers use the numbers in frames and the words in commands."""
    words = [
        (1, "3d", "3D"),
        (4, "6d", "6D"),
        (2, "analog", "Analog"),
        (3, "force", "Force"),
        (5, "event", "Events"),
    ]
    assert [(kind.value, kind.key, kind.command_word) for kind in WIRE_ORDER] == words
    assert set(WIRE_ORDER) == set(ComponentType)
    assert {kind.key: kind for kind in ComponentType} == COMPONENTS_BY_KEY


@both_orders
@each_component
def test_each_component_is_split_and_encoded_as_documented(vector: ComponentVector, order: ByteOrder) -> None:
    """Every field of §7 is where the specification puts it; items may have any byte order and gaps."""
    component = only_component(frame(order, vector.wire[order]), order)
    head = (ComponentType(vector.type), vector.frame_number, vector.timestamp_us)
    assert component == (*head, vector.num_items, vector.item_bytes, order, vector.wire[order][8:])
    assert big_endian_content(component) == vector.wire["big"][8:]
    items = component.items()
    assert (items.shape, items.dtype.itemsize) == ((vector.num_items,), vector.item_bytes)
    assert items.dtype.names == (None if vector is ANALOG else tuple(vector.fields))
    dtype = SHORT_EVENT if vector is SHORT_EVENTS else ITEM_DTYPES[ComponentType(vector.type)]
    made: Array = np.zeros(vector.num_items, dtype)
    for field, expected in vector.fields.items():
        values = values_of(items, field)
        np.testing.assert_array_equal(values, np.array(expected, values.dtype))
        values_of(made, field)[:] = expected
    for each in (made, made.astype(made.dtype.newbyteorder("little")), np.repeat(made, 2)[::2]):
        assert encode_component(*head, each, order) == vector.wire[order]
        assert order == "little" or encode_component(*head, each) == vector.wire[order]  # the default of §4.3


def test_nothing_is_copied_to_read_items() -> None:
    """Copies of every frame would cost more than everything else that the gateway does."""
    for component in split_frame(FULL_FRAME["big"], "big").components:
        items = component.items()
        assert np.shares_memory(items, np.frombuffer(component.content, np.uint8))
        assert big_endian_content(component) is component.content
        with pytest.raises(ValueError, match="read-only"):
            items[0] = items[0]


# Frames ---------------------------------------------------------------------------------------


@both_orders
def test_documented_frames_are_split_and_encoded(order: ByteOrder) -> None:
    """Components of unknown type are skipped, and bytes after the last component are ignored.

    Some programs end every body in LF (field note 17), and NDI's own code ignores it.
    """
    for body, known, unknown in (
        (FULL_FRAME[order], FULL_FRAME_COMPONENTS, ()),
        (EMPTY_FRAME[order], (), ()),
        (FRAME_WITH_UNKNOWN[order], (MARKERS, ANALOG), (9,)),
    ):
        for extra in (b"", b"\n", b"\r\n\0\0", bytes(range(60))):
            split = split_frame(body + extra, order)
            assert [each.content for each in split.components] == [each.wire[order][8:] for each in known]
            assert (split.layout.unknown_types, split.layout.num_extra_bytes) == (unknown, len(extra))
            assert detect_byte_order(body + extra, order) == order
        assert unknown or encode_frame((vector.wire[order] for vector in known), order) == body
    assert encode_frame([MARKERS.wire["big"]]) == frame("big", MARKERS.wire["big"])


def test_a_layout_has_the_most_items_of_a_component_and_the_type_of_the_first_known_one() -> None:
    """Checks of parameters take the most items; the clock of a stream follows the first component."""
    layout = split_frame(
        encode_frame([zeros(ComponentType.ANALOG, count) for count in (2, 3, 1)]), "big"
    ).layout
    assert layout.num_items(list(ComponentType)) == {ComponentType.ANALOG: 3}
    assert layout.num_items({ComponentType.MARKERS}) == {}
    markers, unknown = zeros(ComponentType.MARKERS), bytes.fromhex("0000000c 00000063 00000000")
    frames = [encode_frame(each) for each in ([markers], [unknown, markers], [unknown], [])]
    types = [split_frame(each, "big").layout.first_component_type for each in frames]
    assert types == [ComponentType.MARKERS, ComponentType.MARKERS, None, None]


@both_orders
def test_the_byte_order_of_a_frame_is_detected(order: ByteOrder) -> None:
    """Some servers ignore the byte order they have acknowledged (field note 4)."""
    expected_orders: tuple[ByteOrder, ByteOrder] = ("big", "little")
    for expected in expected_orders:
        assert detect_byte_order(FRAME_WITH_UNKNOWN[order], expected) == order
        assert detect_byte_order(EMPTY_FRAME["big"], expected) == expected
    with pytest.raises(FrameError) as of_split:
        split_frame(FULL_FRAME[order][:-1], order)
    with pytest.raises(FrameError, match=re.escape(str(of_split.value))):
        detect_byte_order(FULL_FRAME[order][:-1], order)


# Contradictions -------------------------------------------------------------------------------


def changed(
    component: bytes, order: ByteOrder, *, size: int | None = None, count: int | None = None
) -> bytes:
    """Return the component's bytes with another size field or item count."""
    new_size = component[:4] if size is None else size.to_bytes(4, order)
    new_count = component[20:24] if count is None else count.to_bytes(4, order)
    return new_size + component[4:20] + new_count + component[24:]


def assert_rejected(body: bytes, order: ByteOrder, *numbers: int) -> None:
    """Assert that the frame is rejected, and that the error's text has each of the numbers."""
    with pytest.raises(FrameError) as caught:
        split_frame(body, order)
    assert set(numbers) <= set(map(int, re.findall(r"\b\d+\b", str(caught.value)))), str(caught.value)


@both_orders
@each_component
def test_sizes_and_counts_that_contradict_each_other(vector: ComponentVector, order: ByteOrder) -> None:
    """No value of such a frame can be trusted, so none may reach a robot."""
    wire = vector.wire[order]
    size = len(wire)
    longer = changed(wire, order, size=size + 1)
    assert_rejected(frame(order, ANALOG.wire[order], longer), order, 2, vector.type, size + 1, size)
    # Not 1 more, because three events of 16 bytes have the size of two events of 24 bytes. The size of 2^30
    # items is a multiple of 2^32 bytes, because every item size is a multiple of 4.
    for count in (vector.num_items - 1, vector.num_items + 2, vector.num_items + 2**30):
        assert_rejected(frame(order, changed(wire, order, count=count)), order, size, count)
    for short in (8, 20, 23):
        cut = short.to_bytes(4, order) + vector.type.to_bytes(4, order) + bytes(short - 8)
        assert_rejected(frame(order, cut), order, short)
        assert_rejected(frame(order, cut, ANALOG.wire[order]), order, short)


@both_orders
def test_frames_that_end_too_soon_or_whose_components_do_not_fit(order: ByteOrder) -> None:
    """A size below the header's, or beyond the end, would make the reader run away."""
    for size in (0, 1, 7):
        for kind in (1, 9):
            component = size.to_bytes(4, order) + kind.to_bytes(4, order) + bytes(16)
            assert_rejected(frame(order, component), order, size, kind, 24)
    for size in (29, 0x7FFFFFFF, 0xFFFFFFFF):
        assert_rejected(frame(order, changed(UNKNOWN_COMPONENT[order], order, size=size)), order, size, 9, 28)
    for item_bytes in (12, 20, 32):
        events = SHORT_EVENTS.wire[order][:24] + bytes(3 * item_bytes)
        component = changed(events, order, size=len(events), count=3)
        assert_rejected(frame(order, component), order, len(events), 3)
    for length in range(len(FULL_FRAME[order])):
        assert_rejected(FULL_FRAME[order][:length], order)
    for length in (0, 1, 3):
        assert_rejected(bytes(length), order, length)
        assert announced_components(bytes(length), order) == 0
    for left in (0, 4, 7):
        body = frame(order, MARKERS.wire[order], ANALOG.wire[order], bytes(left), count=7)
        assert_rejected(body, order, 7, len(body), 2)
        assert announced_components(body, order) == 7


@both_orders
@pytest.mark.timeout(20)  # a loop over the announced count would take minutes
def test_more_than_64_components_are_rejected_before_they_are_read(order: ByteOrder) -> None:
    """A few bytes must not keep the gateway busy."""
    unknown = (8).to_bytes(4, order) + (99).to_bytes(4, order)
    assert len(split_frame(frame(order, *[unknown] * 64), order).layout.unknown_types) == 64
    for count in (65, 2_000_000, 0xFFFFFFFF):
        assert_rejected(frame(order, unknown * min(count, 2_000_000), count=count), order, count, 64)


@pytest.mark.parametrize(
    ("body", "values"),
    [
        ("000000", ["3 bytes"]),
        ("00000041", [65, 64]),
        ("00000002 0000000c 00000063 00000000 00000000", ["2 components", "20 bytes", 1]),
        ("00000002 00000008 00000063 0000000c 00000064", ["2 of 2", "type 100", "size 12", "8 bytes"]),
        ("00000001 00000008 00000001", ["3d", "8 bytes", "0 items"]),
    ],
)
def test_the_error_says_what_contradicts_what(body: str, values: list[object]) -> None:
    """A vendor can find the fault in a server with this line of the log."""
    with raises(FrameError, *values):
        split_frame(bytes.fromhex(body), "big")


# Layouts that repeat --------------------------------------------------------------------------

MARKERS_FRAME = frame("big", MARKERS.wire["big"])


def reader_after(*bodies: bytes) -> FrameReader:
    reader = FrameReader("big")
    for body in bodies:
        reader.read(body)
    return reader


@both_orders
@pytest.mark.parametrize("frames", [FULL_FRAME, FRAME_WITH_UNKNOWN, EMPTY_FRAME])
def test_frames_of_one_layout_share_it(frames: dict[ByteOrder, bytes], order: ByteOrder) -> None:
    """Other connections have layouts of their own, so layouts are forgotten with the connection."""
    reader, expected = FrameReader(order), split_frame(frames[order], order)
    layout = reader.read(frames[order]).layout
    for _ in range(3):
        read = reader.read(bytes(bytearray(frames[order])))
        assert read.layout is layout
        assert read.layout.unknown_types == expected.layout.unknown_types
    assert FrameReader(order).read(frames[order]).layout is not layout


def test_frames_of_one_layout_may_differ_in_number_time_and_items_only() -> None:
    wire = bytearray(MARKERS.wire["big"])
    wire[8:20] = struct.pack(">iq", -7, 2**40)
    wire[24:] = bytes(len(wire) - 24)
    reader = reader_after(MARKERS_FRAME, MARKERS_FRAME)
    read = reader.read(frame("big", bytes(wire)))
    assert read.layout is reader.read(MARKERS_FRAME).layout
    assert (read.number_and_timestamp, read.contents) == ((-7, 2**40), (bytes(wire[8:]),))
    for offset in (3, 7, 11, 27):  # component count, and the component's size, type and count of items
        body = bytearray(MARKERS_FRAME)
        body[offset] ^= 2
        with pytest.raises(FrameError):
            reader.read(bytes(body))


def test_the_number_and_size_of_remembered_layouts_are_bounded() -> None:
    """A server that varies its frames, by mistake or on purpose, must not fill the memory."""
    reader = reader_after(MARKERS_FRAME)  # reading it field by field again would take ten times as long
    assert list(reader._templates) == [len(MARKERS_FRAME)]
    for count in range(100):
        for _ in range(3):
            reader.read(frame("big", zeros(ComponentType.MARKERS, count)))
        assert len(reader._templates) <= len(reader._layouts) <= 64
    large = frame("big", *[zeros(ComponentType.ANALOG, 60_000)] * 64)
    reader = FrameReader("big")
    tracemalloc.start()
    for _ in range(3):
        reader.read(large)
    assert tracemalloc.get_traced_memory()[1] < 100_000
    tracemalloc.stop()
