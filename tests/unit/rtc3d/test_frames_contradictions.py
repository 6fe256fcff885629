"""Frames that contradict themselves (§7), and the byte order in which a frame makes sense."""

import re

import pytest

from gateway.errors import FrameError
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import detect_byte_order, split_frame
from tests.unit.rtc3d.wire import frame
from tests.vectors import (
    ANALOG,
    COMPONENTS,
    EMPTY_FRAME,
    FRAME_WITH_UNKNOWN,
    FULL_FRAME,
    MARKERS,
    SHORT_EVENTS,
    UNKNOWN_COMPONENT,
    ByteOrder,
    ComponentVector,
)

each_component = pytest.mark.parametrize("vector", COMPONENTS, ids=[vector.name for vector in COMPONENTS])
both_orders = pytest.mark.parametrize("order", ["big", "little"])


def changed(
    component: bytes, order: ByteOrder, *, size: int | None = None, count: int | None = None
) -> bytes:
    """Return the component's bytes with another size field or another count of items."""
    new_size = component[:4] if size is None else size.to_bytes(4, order)
    new_count = component[20:24] if count is None else count.to_bytes(4, order)
    return new_size + component[4:20] + new_count + component[24:]


def assert_rejected(body: bytes, order: ByteOrder, *numbers: int) -> None:
    """Assert that the frame is rejected with a text in which each of the numbers stands."""
    with pytest.raises(FrameError) as caught:
        split_frame(body, order)
    said = [int(number) for number in re.findall(r"\b\d+\b", str(caught.value))]
    for number in numbers:
        assert number in said, str(caught.value)


@both_orders
@pytest.mark.parametrize("length", [0, 1, 3])
def test_rejects_a_body_too_short_for_its_count(length: int, order: ByteOrder) -> None:
    assert_rejected(bytes(length), order, length)


@both_orders
@pytest.mark.parametrize("size", [0, 1, 7])
@pytest.mark.parametrize("kind", [1, 9])
def test_rejects_a_component_smaller_than_its_size_and_type(size: int, kind: int, order: ByteOrder) -> None:
    component = size.to_bytes(4, order) + kind.to_bytes(4, order) + bytes(16)
    assert_rejected(frame(order, component), order, size, kind, 24)


@both_orders
@each_component
def test_rejects_a_component_larger_than_the_rest_of_the_frame(
    vector: ComponentVector, order: ByteOrder
) -> None:
    size = len(vector.wire[order])
    body = frame(order, ANALOG.wire[order], changed(vector.wire[order], order, size=size + 1))
    assert_rejected(body, order, 2, vector.type, size + 1, size)


@both_orders
@pytest.mark.parametrize("size", [29, 0x7FFFFFFF, 0xFFFFFFFF])
def test_rejects_an_unknown_component_larger_than_the_rest_of_the_frame(size: int, order: ByteOrder) -> None:
    unknown = changed(UNKNOWN_COMPONENT[order], order, size=size)
    assert_rejected(frame(order, unknown), order, size, 9, 28)


@both_orders
# Not 1: three events of 16 bytes take as much as two of 24.
@pytest.mark.parametrize("difference", [-1, 2])
@each_component
def test_rejects_a_count_that_does_not_fill_the_size(
    vector: ComponentVector, difference: int, order: ByteOrder
) -> None:
    count = vector.num_items + difference
    body = frame(order, changed(vector.wire[order], order, count=count))
    assert_rejected(body, order, len(vector.wire[order]), count)


@both_orders
@each_component
def test_rejects_a_count_whose_bytes_would_fit_only_modulo_32_bits(
    vector: ComponentVector, order: ByteOrder
) -> None:
    # 2^30 items of any size are a multiple of 2^32 bytes.
    count = vector.num_items + 2**30
    body = frame(order, changed(vector.wire[order], order, count=count))
    assert_rejected(body, order, len(vector.wire[order]), count)


@both_orders
@pytest.mark.parametrize("size", [8, 20, 23])
@pytest.mark.parametrize("kind", ComponentType)
def test_rejects_a_known_component_without_room_for_its_count(
    kind: ComponentType, size: int, order: ByteOrder
) -> None:
    cut = size.to_bytes(4, order) + int(kind).to_bytes(4, order) + bytes(size - 8)
    assert_rejected(frame(order, cut), order, size)
    assert_rejected(frame(order, cut, ANALOG.wire[order]), order, size)


@both_orders
@pytest.mark.parametrize("item_bytes", [12, 20, 32])
def test_rejects_events_of_neither_16_nor_24_bytes(item_bytes: int, order: ByteOrder) -> None:
    size = 24 + 3 * item_bytes
    component = changed(SHORT_EVENTS.wire[order][:24] + bytes(3 * item_bytes), order, size=size, count=3)
    assert_rejected(frame(order, component), order, size, 3)


@both_orders
@pytest.mark.parametrize("trailing", [1, 3, 4, 60])
def test_rejects_bytes_after_the_last_component(trailing: int, order: ByteOrder) -> None:
    assert_rejected(FULL_FRAME[order] + bytes(trailing), order, trailing, 5)
    assert_rejected(EMPTY_FRAME[order] + bytes(trailing), order, trailing, 0)


@both_orders
@pytest.mark.parametrize("left", [0, 4, 7])
def test_rejects_a_count_larger_than_the_components_that_came(left: int, order: ByteOrder) -> None:
    body = frame(order, MARKERS.wire[order], ANALOG.wire[order], bytes(left), count=7)
    assert_rejected(body, order, 7, len(body), 2)


@both_orders
def test_rejects_every_frame_that_was_cut(order: ByteOrder) -> None:
    for length in range(len(FULL_FRAME[order])):
        assert_rejected(FULL_FRAME[order][:length], order)


# A loop over the announced count would take minutes.
@pytest.mark.timeout(20)
@both_orders
@pytest.mark.parametrize(
    "rest",
    [b"", bytes(24), bytes(4096)],
    ids=["nothing follows", "a component of size 0", "many components of size 0"],
)
def test_4_billion_announced_components_are_rejected_at_once(rest: bytes, order: ByteOrder) -> None:
    assert_rejected(frame(order, rest, count=0xFFFFFFFF), order, 0xFFFFFFFF)


# Byte order ----------------------------------------------------------------------------------


@both_orders
@pytest.mark.parametrize("expected", ["big", "little"])
@each_component
def test_finds_the_byte_order_of_a_frame(
    vector: ComponentVector, expected: ByteOrder, order: ByteOrder
) -> None:
    assert detect_byte_order(frame(order, vector.wire[order]), expected) == order


@both_orders
@pytest.mark.parametrize("expected", ["big", "little"])
def test_finds_the_byte_order_of_a_frame_with_an_unknown_component(
    expected: ByteOrder, order: ByteOrder
) -> None:
    assert detect_byte_order(FRAME_WITH_UNKNOWN[order], expected) == order


@both_orders
def test_a_frame_that_makes_sense_in_both_orders_is_in_the_expected_one(order: ByteOrder) -> None:
    assert detect_byte_order(EMPTY_FRAME["big"], order) == order


@both_orders
def test_a_frame_that_makes_sense_in_no_order_gets_the_expected_orders_error(order: ByteOrder) -> None:
    with pytest.raises(FrameError) as of_split:
        split_frame(FULL_FRAME[order] + b"\0", order)
    with pytest.raises(FrameError) as of_search:
        detect_byte_order(FULL_FRAME[order] + b"\0", order)
    assert str(of_search.value) == str(of_split.value)
