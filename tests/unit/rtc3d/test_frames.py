"""Splitting frames into components, and encoding them."""

import numpy as np
import pytest

from gateway.rtc3d.components import LONG_EVENT, SHORT_EVENT, ComponentType, encode_component
from gateway.rtc3d.frames import detect_byte_order, encode_frame, split_frame
from tests.unit.rtc3d.wire import frame, only_component
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
    ByteOrder,
)

both_orders = pytest.mark.parametrize("order", ["big", "little"])


@both_orders
def test_a_frame_of_all_five_components_is_split(order: ByteOrder) -> None:
    split = split_frame(FULL_FRAME[order], order)
    assert [component.type.key for component in split.components] == ["3d", "6d", "analog", "force", "event"]
    assert [bytes(component.content) for component in split.components] == [
        vector.wire[order][8:] for vector in FULL_FRAME_COMPONENTS
    ]
    assert split.unknown_types == ()


@both_orders
def test_a_frame_of_all_five_components_is_encoded(order: ByteOrder) -> None:
    parts = (vector.wire[order] for vector in FULL_FRAME_COMPONENTS)
    assert encode_frame(parts, order) == FULL_FRAME[order]


def test_a_layout_counts_the_items_of_components_that_may_be_repeated() -> None:
    encoded = [encode_component(ComponentType.ANALOG, 1, 1, np.zeros(count, ">f4")) for count in (2, 3, 1)]
    layout = split_frame(encode_frame(encoded), "big").layout
    assert layout.num_items(list(ComponentType)) == {ComponentType.ANALOG: 3}
    assert layout.num_items({ComponentType.MARKERS}) == {}


@both_orders
def test_an_empty_frame_has_no_components(order: ByteOrder) -> None:
    split = split_frame(EMPTY_FRAME[order], order)
    assert (split.components, split.unknown_types) == ((), ())
    assert encode_frame([], order) == EMPTY_FRAME[order]


@both_orders
def test_an_unknown_component_is_skipped_and_its_type_listed(order: ByteOrder) -> None:
    split = split_frame(FRAME_WITH_UNKNOWN[order], order)
    assert [bytes(component.content) for component in split.components] == [
        MARKERS.wire[order][8:],
        ANALOG.wire[order][8:],
    ]
    assert split.unknown_types == (9,)


@both_orders
@pytest.mark.parametrize("data_bytes", [0, 1, 12, 15, 16, 17])
def test_an_unknown_component_may_have_any_size(data_bytes: int, order: ByteOrder) -> None:
    unknown = (8 + data_bytes).to_bytes(4, order) + (0).to_bytes(4, order) + bytes(data_bytes)
    split = split_frame(frame(order, unknown), order)
    assert (split.components, split.unknown_types) == ((), (0,))
    split = split_frame(frame(order, unknown, ANALOG.wire[order], unknown), order)
    assert [component.type.key for component in split.components] == ["analog"]
    assert split.unknown_types == (0, 0)


@both_orders
def test_events_of_16_and_of_24_bytes_may_be_in_one_frame(order: ByteOrder) -> None:
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
def test_the_frame_that_controls_wavefronts_recording_is_split_and_encoded(
    packet: bytes, order: ByteOrder, event_id: int
) -> None:
    body = packet[8:]
    assert detect_byte_order(body, "big") == order
    component = only_component(body, order)
    assert component.type is ComponentType.EVENT
    assert component.frame_number == -1
    assert component.item_bytes == 24
    assert component.items().tolist() == [(event_id, 0, -1, -1, -1)]

    events = np.array([(event_id, 0, -1, -1, -1)], LONG_EVENT)
    assert encode_frame([encode_component(ComponentType.EVENT, -1, 0, events, order)], order) == body
