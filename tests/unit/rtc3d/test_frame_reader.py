"""Frames that repeat the layout of an earlier frame, and frames that only appear to."""

import struct
import tracemalloc

import numpy as np
import pytest

from gateway.errors import FrameError
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType, encode_component
from gateway.rtc3d.frame_reader import FrameReader
from gateway.rtc3d.frames import split_frame
from tests.unit.rtc3d.wire import bodies_of_both_orders, frame
from tests.vectors import MARKERS, ByteOrder

MARKERS_FRAME = frame("big", MARKERS.wire["big"])


def reader_after(*bodies: bytes, order: ByteOrder = "big") -> FrameReader:
    reader = FrameReader(order)
    for body in bodies:
        reader.read(body)
    return reader


@bodies_of_both_orders
def test_all_frames_of_a_layout_are_read_alike_and_share_it(body: bytes, order: ByteOrder) -> None:
    reader = FrameReader(order)
    expected = split_frame(body, order)
    layout = reader.read(body).layout
    for _ in range(3):
        read = reader.read(bytes(bytearray(body)))
        assert read.layout is layout
        assert read.layout.fields == expected.layout.fields
        assert read.components == expected.components
        assert read.unknown_types == expected.unknown_types


def test_frames_of_one_layout_may_differ_in_number_time_and_items() -> None:
    wire = bytearray(MARKERS.wire["big"])
    wire[8:20] = struct.pack(">iq", -7, 2**40)
    wire[24:] = bytes(len(wire) - 24)
    reader = reader_after(MARKERS_FRAME, MARKERS_FRAME)
    read = reader.read(frame("big", bytes(wire)))
    assert read.layout is reader.read(MARKERS_FRAME).layout
    assert read.number_and_timestamp == (-7, 2**40)
    assert read.contents == (bytes(wire[8:]),)


# Component count, and the component's size, type and count of items.
@pytest.mark.parametrize("offset", [3, 7, 11, 27])
def test_a_frame_that_differs_in_anything_else_does_not_have_the_layout(offset: int) -> None:
    body = bytearray(MARKERS_FRAME)
    body[offset] ^= 2
    with pytest.raises(FrameError):
        reader_after(MARKERS_FRAME, MARKERS_FRAME).read(bytes(body))


def test_two_layouts_of_the_same_size_are_distinguished() -> None:
    bodies = [
        frame("big", encode_component(kind, 1, 1, np.zeros(count, ITEM_DTYPES[kind])))
        for kind, count in ((ComponentType.MARKERS, 2), (ComponentType.TOOLS, 1))
    ]
    reader = FrameReader("big")
    read = [reader.read(body).layout for body in bodies * 3]
    assert [layout.fields for layout in read] == [
        split_frame(body, "big").layout.fields for body in bodies * 3
    ]
    assert read == read[:2] * 3
    assert read[0] is not read[1]


def test_the_number_of_remembered_layouts_is_bounded() -> None:
    """A server that varies its frames, by mistake or on purpose, must not fill the memory."""
    reader = FrameReader("big")
    for count in range(100):
        markers = np.zeros(count, ITEM_DTYPES[ComponentType.MARKERS])
        for _ in range(3):
            reader.read(frame("big", encode_component(ComponentType.MARKERS, 1, 1, markers)))
        assert len(reader._templates) <= len(reader._layouts) <= 64


def test_a_layout_that_repeats_is_recognised_by_its_template() -> None:
    """Reading every frame field by field would take ten times as long."""
    reader = reader_after(MARKERS_FRAME)
    assert reader._templates == {}
    reader.read(MARKERS_FRAME)
    assert list(reader._templates) == [len(MARKERS_FRAME)]


def test_layouts_of_one_connection_are_not_those_of_another() -> None:
    """So they are forgotten with the connection."""
    first, second = (reader_after(MARKERS_FRAME).read(MARKERS_FRAME).layout for _ in range(2))
    assert first is not second


def test_a_layout_of_large_components_takes_little_memory() -> None:
    body = frame("big", *[encode_component(ComponentType.ANALOG, 1, 1, np.zeros(60_000, ">f4"))] * 64)
    reader = FrameReader("big")
    tracemalloc.start()
    for _ in range(3):
        reader.read(body)
    assert tracemalloc.get_traced_memory()[1] < 100_000
    tracemalloc.stop()
