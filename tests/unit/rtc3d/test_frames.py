"""Frames split field by field, and recognised by their layout."""

import struct
from typing import Any

import numpy as np
import pytest

from gateway.rtc3d.components import ITEM_DTYPES, LONG_EVENT, SHORT_EVENT, ComponentType, build_component
from gateway.rtc3d.frames import Frame, KnownLayouts, Layout, build_frame, byte_order_of, split_frame
from tests.servers import packet
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
    split = split_frame(EMPTY_FRAME[order], order)
    assert (split.components, split.unknown_types) == ((), ())
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
    split = split_frame(frame(order, unknown), order)
    assert (split.components, split.unknown_types) == ((), (0,))
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


# Layouts -------------------------------------------------------------------------------------

bodies_of_both_orders = pytest.mark.parametrize(
    ("body", "order"),
    [
        (frames[order], order)
        for frames in (FULL_FRAME, FRAME_WITH_UNKNOWN, EMPTY_FRAME)
        for order in ("big", "little")
    ],
)


def cut(layout: Layout, body: bytes) -> Frame | None:
    layouts = KnownLayouts()
    layouts.learn(layout)
    frames: list[Frame] = []
    end = layouts.cut(b"before" + packet(3, body), 6, frames)
    assert end == 6 + len(frames) * layout.packet_bytes
    return frames[0] if frames else None


@bodies_of_both_orders
def test_a_layout_cuts_its_own_frame_as_it_was_split(body: bytes, order: ByteOrder) -> None:
    split = split_frame(body, order)
    assert split.layout.packet_bytes == 8 + len(body)
    again = cut(split.layout, body)
    assert again is not None
    assert again.components == split.components
    assert again.unknown_types == split.unknown_types


@bodies_of_both_orders
def test_frames_laid_out_alike_have_the_same_layout(body: bytes, order: ByteOrder) -> None:
    assert split_frame(body, order).layout is split_frame(bytes(bytearray(body)), order).layout


def test_numbers_times_and_items_may_differ() -> None:
    layout = split_frame(frame("big", MARKERS.wire["big"]), "big").layout
    wire = bytearray(MARKERS.wire["big"])
    wire[8:20] = struct.pack(">iq", -7, 2**40)
    wire[24:] = bytes(len(wire) - 24)
    found = cut(layout, frame("big", bytes(wire)))
    assert found is not None
    assert found.number_and_time == (-7, 2**40)
    assert found.contents == (bytes(wire[8:]),)


# Packet type, component count, and the component's size, type and count of items.
@pytest.mark.parametrize("offset", [7, 11, 15, 19, 35])
def test_whatever_else_differs_is_not_recognised(offset: int) -> None:
    body = frame("big", MARKERS.wire["big"])
    layouts = known(body)
    other = bytearray(packet(3, body))
    other[offset] ^= 1
    assert layouts.cut(bytes(other), 0, []) == 0


def known(*bodies: bytes) -> KnownLayouts:
    layouts = KnownLayouts()
    for body in bodies:
        layouts.learn(split_frame(body, "big").layout)
    return layouts


def test_known_layouts_cut_up_to_the_first_packet_that_is_not_whole_or_not_known() -> None:
    markers, analog = (packet(3, frame("big", vector.wire["big"])) for vector in (MARKERS, ANALOG))
    layouts = known(markers[8:], analog[8:])
    for rest in (b"", markers[:11], markers[:-1], packet(4), packet(3, FULL_FRAME["big"])):
        found: list[Any] = []
        assert layouts.cut(b"0" + markers + analog + markers + rest, 1, found) == 1 + len(
            markers + analog + markers
        )
        assert [split.layout.parts[0].type for split in found] == [
            ComponentType.MARKERS,
            ComponentType.ANALOG,
            ComponentType.MARKERS,
        ]


def test_the_newest_layout_tells_how_long_the_next_packet_will_be() -> None:
    assert KnownLayouts().newest_bytes == 0
    markers, analog = (frame("big", vector.wire["big"]) for vector in (MARKERS, ANALOG))
    layouts = known(markers, analog)
    assert layouts.newest_bytes == 8 + len(analog)
    layouts.learn(split_frame(markers, "big").layout)
    assert layouts.newest_bytes == 8 + len(markers)


def test_of_two_layouts_that_begin_alike_the_newest_is_known() -> None:
    bodies = [
        frame("big", build_component(kind, 1, 1, np.zeros(count, ITEM_DTYPES[kind])))
        for kind, count in ((ComponentType.MARKERS, 2), (ComponentType.TOOLS, 1))
    ]
    layouts = known(*bodies)
    assert [layouts.cut(packet(3, body), 0, []) for body in bodies] == [0, 8 + len(bodies[1])]


def test_layouts_without_number_are_forgotten() -> None:
    bodies = [
        frame("big", build_component(ComponentType.ANALOG, 1, 1, np.zeros(count, ">f4")))
        for count in range(33)
    ]
    layouts = known(*bodies)
    assert layouts.cut(packet(3, bodies[0]), 0, []) == 0
    assert layouts.cut(packet(3, bodies[-1]), 0, []) == 8 + len(bodies[-1])
