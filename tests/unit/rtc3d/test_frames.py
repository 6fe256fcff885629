"""Data frames (§7.1): splitting and encoding them, those that contradict themselves, and their byte order."""

import re

import numpy as np
import pytest

from gateway.errors import FrameError
from gateway.rtc3d.components import ITEM_DTYPES, LONG_EVENT, SHORT_EVENT, ComponentType, encode_component
from gateway.rtc3d.frames import announced_components, detect_byte_order, encode_frame, split_frame
from tests.unit.rtc3d.wire import both_orders, each_component, frame, only_component
from tests.vectors import (
    ANALOG,
    EMPTY_FRAME,
    FRAME_WITH_UNKNOWN,
    FULL_FRAME,
    FULL_FRAME_COMPONENTS,
    LONG_EVENTS,
    MARKERS,
    SHORT_EVENTS,
    START_RECORDING,
    STOP_RECORDING,
    UNKNOWN_COMPONENT,
    ByteOrder,
    ComponentVector,
)


@both_orders
def test_documented_frames_are_split_and_encoded(order: ByteOrder) -> None:
    """The vectors have all five components, none, and one of an unknown type, which is skipped."""
    for body, known, unknown in (
        (FULL_FRAME, FULL_FRAME_COMPONENTS, ()),
        (EMPTY_FRAME, (), ()),
        (FRAME_WITH_UNKNOWN, (MARKERS, ANALOG), (9,)),
    ):
        split = split_frame(body[order], order)
        assert [component.content for component in split.components] == [
            vector.wire[order][8:] for vector in known
        ]
        assert split.unknown_types == unknown
        if not unknown:
            assert encode_frame((vector.wire[order] for vector in known), order) == body[order]


def test_a_layout_counts_the_items_of_components_that_may_be_repeated() -> None:
    """Queries and checks of parameters take the most items that a component has."""
    encoded = [encode_component(ComponentType.ANALOG, 1, 1, np.zeros(count, ">f4")) for count in (2, 3, 1)]
    layout = split_frame(encode_frame(encoded), "big").layout
    assert layout.num_items(list(ComponentType)) == {ComponentType.ANALOG: 3}
    assert layout.num_items({ComponentType.MARKERS}) == {}


def test_the_first_known_component_gives_a_layout_its_type() -> None:
    """The clock of a stream follows this component."""
    markers = encode_component(ComponentType.MARKERS, 1, 0, np.zeros(1, ITEM_DTYPES[ComponentType.MARKERS]))
    unknown = bytes.fromhex("0000000c 00000063 00000000")
    types = [
        split_frame(encode_frame(components), "big").layout.first_component_type
        for components in ([markers], [unknown, markers], [unknown], [])
    ]
    assert types == [ComponentType.MARKERS, ComponentType.MARKERS, None, None]


@both_orders
def test_events_of_16_and_of_24_bytes_may_be_in_one_frame(order: ByteOrder) -> None:
    """Field note 6: the specification and NDI's code differ, and the size decides."""
    short, long = split_frame(
        frame(order, SHORT_EVENTS.wire[order], LONG_EVENTS.wire[order]), order
    ).components
    assert (short.item_bytes, long.item_bytes) == (16, 24)
    assert short.items().dtype.names == SHORT_EVENT.names
    assert long.items().dtype.names == LONG_EVENT.names
    assert short.items()["param1"].tolist() == long.items()["param1"].tolist() == [7, 1065353216]


@pytest.mark.parametrize(
    ("packet", "order", "event_id"), [(START_RECORDING, "little", 1), (STOP_RECORDING, "big", 0)]
)
def test_the_frame_that_controls_wavefronts_recording_is_split_and_encoded(
    packet: bytes, order: ByteOrder, event_id: int
) -> None:
    """Field note 16 was captured from NDI's own client."""
    body = packet[8:]
    assert detect_byte_order(body, "big") == order
    component = only_component(body, order)
    assert (component.type, component.frame_number, component.item_bytes) == (ComponentType.EVENT, -1, 24)
    assert component.items().tolist() == [(event_id, 0, -1, -1, -1)]
    events = np.array([(event_id, 0, -1, -1, -1)], LONG_EVENT)
    assert encode_frame([encode_component(ComponentType.EVENT, -1, 0, events, order)], order) == body


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
    found = [int(number) for number in re.findall(r"\b\d+\b", str(caught.value))]
    assert set(numbers) <= set(found), str(caught.value)


@both_orders
@each_component
def test_sizes_and_counts_of_a_known_component_that_contradict_each_other(
    vector: ComponentVector, order: ByteOrder
) -> None:
    """No value of such a frame can be trusted, so none may reach a robot."""
    wire = vector.wire[order]
    size = len(wire)
    longer = changed(wire, order, size=size + 1)
    assert_rejected(frame(order, ANALOG.wire[order], longer), order, 2, vector.type, size + 1, size)
    # Not 1 more, because three events of 16 bytes have the size of two events of 24 bytes. The size of 2^30
    # items is a multiple of 2^32 bytes, because every item size is a multiple of 4.
    for difference in (-1, 2, 2**30):
        count = vector.num_items + difference
        assert_rejected(frame(order, changed(wire, order, count=count)), order, size, count)
    for short in (8, 20, 23):
        cut = short.to_bytes(4, order) + vector.type.to_bytes(4, order) + bytes(short - 8)
        assert_rejected(frame(order, cut), order, short)
        assert_rejected(frame(order, cut, ANALOG.wire[order]), order, short)


@both_orders
def test_sizes_of_any_component_that_do_not_fit_the_frame(order: ByteOrder) -> None:
    """A size below the header's, or beyond the end, would make the reader run away."""
    for size in (0, 1, 7):
        for kind in (1, 9):
            component = size.to_bytes(4, order) + kind.to_bytes(4, order) + bytes(16)
            assert_rejected(frame(order, component), order, size, kind, 24)
    for size in (29, 0x7FFFFFFF, 0xFFFFFFFF):
        unknown = changed(UNKNOWN_COMPONENT[order], order, size=size)
        assert_rejected(frame(order, unknown), order, size, 9, 28)
    for item_bytes in (12, 20, 32):
        events = SHORT_EVENTS.wire[order][:24] + bytes(3 * item_bytes)
        component = changed(events, order, size=len(events), count=3)
        assert_rejected(frame(order, component), order, len(events), 3)


@both_orders
def test_frames_that_end_too_soon(order: ByteOrder) -> None:
    """A frame is whole or worthless, wherever it is cut and however many components it announces."""
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
    assert len(split_frame(frame(order, *[unknown] * 64), order).unknown_types) == 64
    for count in (65, 2_000_000, 0xFFFFFFFF):
        assert_rejected(frame(order, unknown * min(count, 2_000_000), count=count), order, count, 64)


@pytest.mark.parametrize(
    ("body", "text"),
    [
        ("000000", "data frame of 3 bytes: too short for its component count"),
        ("00000041", "data frame announces 65 components, more than 64"),
        (
            "00000002 0000000c 00000063 00000000 00000000",
            "data frame announces 2 components; its 20 bytes end after 1",
        ),
        (
            "00000002 00000008 00000063 0000000c 00000064",
            "component 2 of 2 (type 100) has size 12; 8 bytes are left in the frame",
        ),
        ("00000001 00000008 00000001", "3d component of 8 bytes announces 0 items"),
    ],
)
def test_the_error_says_what_contradicts_what(body: str, text: str) -> None:
    """A vendor can find the fault in a server with this line of the log."""
    with pytest.raises(FrameError) as caught:
        split_frame(bytes.fromhex(body), "big")
    assert str(caught.value) == text


@both_orders
def test_bytes_after_the_last_component_are_ignored(order: ByteOrder) -> None:
    """Some programs end every body in LF (field note 17), and NDI's own code ignores it."""
    for body in (FULL_FRAME[order], FRAME_WITH_UNKNOWN[order], EMPTY_FRAME[order]):
        whole = split_frame(body, order)
        for extra in (b"", b"\n", b"\0\0\0", b"\r\n\0\0", bytes(range(60))):
            extended = split_frame(body + extra, order)
            assert extended.components == whole.components
            assert extended.unknown_types == whole.unknown_types
            assert extended.layout.num_extra_bytes == len(extra)
            assert detect_byte_order(body + extra, order) == order


@both_orders
def test_the_byte_order_of_a_frame_is_detected(order: ByteOrder) -> None:
    """Some servers ignore the byte order they have acknowledged (field note 4)."""
    expected_orders: tuple[ByteOrder, ByteOrder] = ("big", "little")
    for expected in expected_orders:
        assert detect_byte_order(FRAME_WITH_UNKNOWN[order], expected) == order
        assert detect_byte_order(EMPTY_FRAME["big"], expected) == expected
    cut = FULL_FRAME[order][:-1]
    with pytest.raises(FrameError) as of_split:
        split_frame(cut, order)
    with pytest.raises(FrameError, match=re.escape(str(of_split.value))):
        detect_byte_order(cut, order)
