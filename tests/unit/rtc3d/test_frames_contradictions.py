"""Frames that contradict themselves (§7), and detection of the byte order."""

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
    """Return the component's bytes with another size field or item count."""
    new_size = component[:4] if size is None else size.to_bytes(4, order)
    new_count = component[20:24] if count is None else count.to_bytes(4, order)
    return new_size + component[4:20] + new_count + component[24:]


def assert_rejected(body: bytes, order: ByteOrder, *numbers: int) -> None:
    """Assert that the frame is rejected, and that the error's text has each of the numbers."""
    with pytest.raises(FrameError) as caught:
        split_frame(body, order)
    found = [int(number) for number in re.findall(r"\b\d+\b", str(caught.value))]
    for number in numbers:
        assert number in found, str(caught.value)


@both_orders
@pytest.mark.parametrize("length", [0, 1, 3])
def test_a_body_too_short_for_its_component_count_is_rejected(length: int, order: ByteOrder) -> None:
    assert_rejected(bytes(length), order, length)


@both_orders
@pytest.mark.parametrize("size", [0, 1, 7])
@pytest.mark.parametrize("kind", [1, 9])
def test_a_component_too_small_for_size_and_type_is_rejected(size: int, kind: int, order: ByteOrder) -> None:
    component = size.to_bytes(4, order) + kind.to_bytes(4, order) + bytes(16)
    assert_rejected(frame(order, component), order, size, kind, 24)


@both_orders
@each_component
def test_a_component_beyond_the_end_of_the_frame_is_rejected(
    vector: ComponentVector, order: ByteOrder
) -> None:
    size = len(vector.wire[order])
    body = frame(order, ANALOG.wire[order], changed(vector.wire[order], order, size=size + 1))
    assert_rejected(body, order, 2, vector.type, size + 1, size)


@both_orders
@pytest.mark.parametrize("size", [29, 0x7FFFFFFF, 0xFFFFFFFF])
def test_an_unknown_component_beyond_the_end_of_the_frame_is_rejected(size: int, order: ByteOrder) -> None:
    unknown = changed(UNKNOWN_COMPONENT[order], order, size=size)
    assert_rejected(frame(order, unknown), order, size, 9, 28)


@both_orders
# Not 1, because three events of 16 bytes have the size of two events of 24 bytes.
@pytest.mark.parametrize("difference", [-1, 2])
@each_component
def test_an_item_count_that_does_not_fit_the_size_is_rejected(
    vector: ComponentVector, difference: int, order: ByteOrder
) -> None:
    count = vector.num_items + difference
    body = frame(order, changed(vector.wire[order], order, count=count))
    assert_rejected(body, order, len(vector.wire[order]), count)


@both_orders
@each_component
def test_an_item_count_that_fits_only_modulo_32_bits_is_rejected(
    vector: ComponentVector, order: ByteOrder
) -> None:
    # The size of 2^30 items is a multiple of 2^32 bytes, because every item size is a multiple of 4.
    count = vector.num_items + 2**30
    body = frame(order, changed(vector.wire[order], order, count=count))
    assert_rejected(body, order, len(vector.wire[order]), count)


@both_orders
@pytest.mark.parametrize("size", [8, 20, 23])
@pytest.mark.parametrize("kind", ComponentType)
def test_a_known_component_too_short_for_its_item_count_is_rejected(
    kind: ComponentType, size: int, order: ByteOrder
) -> None:
    cut = size.to_bytes(4, order) + int(kind).to_bytes(4, order) + bytes(size - 8)
    assert_rejected(frame(order, cut), order, size)
    assert_rejected(frame(order, cut, ANALOG.wire[order]), order, size)


@both_orders
@pytest.mark.parametrize("item_bytes", [12, 20, 32])
def test_events_of_neither_16_nor_24_bytes_are_rejected(item_bytes: int, order: ByteOrder) -> None:
    size = 24 + 3 * item_bytes
    component = changed(SHORT_EVENTS.wire[order][:24] + bytes(3 * item_bytes), order, size=size, count=3)
    assert_rejected(frame(order, component), order, size, 3)


@both_orders
@pytest.mark.parametrize("extra", [b"\n", b"\0\0\0", b"\r\n\0\0", bytes(range(60))])
def test_bytes_after_the_last_component_are_ignored(extra: bytes, order: ByteOrder) -> None:
    for body in (FULL_FRAME[order], FRAME_WITH_UNKNOWN[order], EMPTY_FRAME[order]):
        whole, extended = split_frame(body, order), split_frame(body + extra, order)
        assert extended.components == whole.components
        assert extended.unknown_types == whole.unknown_types
        assert (whole.layout.num_extra_bytes, extended.layout.num_extra_bytes) == (0, len(extra))
        assert detect_byte_order(body + extra, order) == order


@both_orders
@pytest.mark.parametrize("left", [0, 4, 7])
def test_a_component_count_above_the_number_of_components_is_rejected(left: int, order: ByteOrder) -> None:
    body = frame(order, MARKERS.wire[order], ANALOG.wire[order], bytes(left), count=7)
    assert_rejected(body, order, 7, len(body), 2)


@both_orders
def test_every_truncated_frame_is_rejected(order: ByteOrder) -> None:
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


# Byte order -----------------------------------------------------------------------------------


@both_orders
@pytest.mark.parametrize("expected", ["big", "little"])
@each_component
def test_the_byte_order_of_a_frame_is_detected(
    vector: ComponentVector, expected: ByteOrder, order: ByteOrder
) -> None:
    assert detect_byte_order(frame(order, vector.wire[order]), expected) == order


@both_orders
@pytest.mark.parametrize("expected", ["big", "little"])
def test_the_byte_order_of_a_frame_with_an_unknown_component_is_detected(
    expected: ByteOrder, order: ByteOrder
) -> None:
    assert detect_byte_order(FRAME_WITH_UNKNOWN[order], expected) == order


@both_orders
def test_a_frame_that_makes_sense_in_both_orders_has_the_expected_one(order: ByteOrder) -> None:
    assert detect_byte_order(EMPTY_FRAME["big"], order) == order


@both_orders
def test_if_neither_order_makes_sense_the_error_is_that_of_the_expected_one(
    order: ByteOrder,
) -> None:
    with pytest.raises(FrameError) as of_split:
        split_frame(FULL_FRAME[order][:-1], order)
    with pytest.raises(FrameError) as of_search:
        detect_byte_order(FULL_FRAME[order][:-1], order)
    assert str(of_search.value) == str(of_split.value)


@both_orders
@pytest.mark.parametrize("count", [65, 2_000_000, 0xFFFFFFFF])
def test_a_frame_with_more_than_64_components_is_rejected_before_they_are_read(
    count: int, order: ByteOrder
) -> None:
    unknown = (8).to_bytes(4, order) + (99).to_bytes(4, order)
    assert_rejected(frame(order, unknown * min(count, 2_000_000), count=count), order, count, 64)
    assert len(split_frame(frame(order, *[unknown] * 64), order).unknown_types) == 64
