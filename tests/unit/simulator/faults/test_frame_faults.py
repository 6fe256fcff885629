"""Faults of data frames, by the tables of the specification."""

import math
import struct

import pytest

from gateway.errors import FrameError
from gateway.rtc3d.frames import split_frame
from gateway.simulator.faults.base import LastingConnectionFault
from gateway.simulator.faults.frame_faults import (
    FrozenTimestamps,
    JumpingTimestamps,
    Occlusion,
    ShortEvents,
    UnknownComponent,
    WrongByteOrder,
    WrongCounts,
)
from gateway.simulator.faults.kinds import KINDS
from tests.unit.rtc3d_server.wire import COMMAND, DATA, MARKERS, TOOLS, ByteOrder, packet, packets_in
from tests.unit.simulator.faults.faulty_client import active, changed, components_in_packet, frame, markers

MISSING = b"\xff" * 4


@pytest.mark.parametrize(("fraction", "hidden"), [(0.0, 0), (0.01, 1), (0.5, 4), (0.51, 5), (1.0, 8)])
def test_occlusion_hides_a_fraction_of_the_markers_until_it_begins_again(
    fraction: float, hidden: int
) -> None:
    [component] = components_in_packet(changed(Occlusion(markers=fraction), frame(markers(count=8))))
    seen = [item for item in component.items if not math.isnan(item[0])]
    assert len(seen) == 8 - hidden
    assert all(item[1:] == (1.5, -2.0, 0.25) for item in seen)
    fault, data = Occlusion(markers=0.5), frame(markers(count=100))
    occlusion = active(fault)
    occlusion.begin()
    first, second = (changed(fault, data, occlusion) for _ in range(2))
    occlusion.begin()
    assert first == second != changed(fault, data, occlusion)


def test_hidden_markers_and_tools_have_the_bytes_of_field_note_7() -> None:
    tool = struct.pack(">IIiqI8f", 24 + 32, TOOLS, 7, 9000, 1, 1, 0, 0, 0, 10, 20, 30, 0.5)
    data = changed(Occlusion(), frame(markers(count=1), tool))
    assert data[8 + 4 + 24 : 8 + 4 + 40] == MISSING * 3 + struct.pack(">f", 999.0)
    assert data[-32:] == MISSING * 8
    heads = [each[:3] for each in components_in_packet(data)]
    assert heads == [(MARKERS, 7, 9000), (TOOLS, 7, 9000)]


def test_frozen_time_stamps_are_those_of_the_first_frame_since_the_fault_began() -> None:
    frozen = active(FrozenTimestamps())
    changed(FrozenTimestamps(), frame(markers(number=1, timestamp_us=1234)), frozen)
    data = changed(FrozenTimestamps(), frame(markers(number=2, timestamp_us=5)), frozen)
    assert data == frame(markers(number=2, timestamp_us=1234))
    frozen.begin()
    assert changed(FrozenTimestamps(), data := frame(markers(timestamp_us=77)), frozen) == data


@pytest.mark.parametrize(("jump_ms", "timestamp_us"), [(-5, 4000), (0.5, 9500), (1e12, 10**15 + 9000)])
def test_time_stamps_jump(jump_ms: float, timestamp_us: int) -> None:
    data = changed(JumpingTimestamps(jump_ms=jump_ms), frame(markers()))
    assert data == frame(markers(timestamp_us=timestamp_us))


def test_events_can_have_16_bytes() -> None:
    header = struct.Struct(">IIiqI")
    items = struct.pack(">iqiiiiqiii", 1, 8000, 2, 3, 4, 5, 8500, 6, 7, 8)
    long = header.pack(24 + 48, 5, 7, 9000, 2) + items
    short = header.pack(24 + 32, 5, 7, 9000, 2) + struct.pack(">8i", 1, 2, 3, 4, 5, 6, 7, 8)
    assert changed(ShortEvents(), frame(markers(), long)) == frame(markers(), short)


@pytest.mark.parametrize(
    ("order", "requested", "sent"),
    [
        *(("big", "little", "big"), ("little", "little", "little"), ("little", "big", "little")),
        *(("other", "big", "little"), ("other", "little", "big")),
    ],
)
def test_frames_can_have_another_byte_order(order: str, requested: ByteOrder, sent: ByteOrder) -> None:
    fault = WrongByteOrder.model_validate({"byte_order": order})
    data = changed(fault, frame(markers(requested), byte_order=requested))
    assert data == frame(markers(sent), byte_order=sent)


@pytest.mark.parametrize("byte_order", ["big", "little"])
def test_an_unknown_component_comes_last_with_a_header_like_any_other(byte_order: ByteOrder) -> None:
    sign = ">" if byte_order == "big" else "<"
    unknown = struct.pack(sign + "IIiq", 20 + 5, 99, 0, 0) + bytes(5)
    data = changed(
        UnknownComponent(component_type=99, data_bytes=5), frame(markers(byte_order), byte_order=byte_order)
    )
    assert data == frame(markers(byte_order), unknown, byte_order=byte_order)


@pytest.mark.parametrize("field", ["components", "size", "items"])
@pytest.mark.parametrize("byte_order", ["big", "little"])
def test_wrong_counts_are_invalid_in_either_byte_order(field: str, byte_order: ByteOrder) -> None:
    good = frame(markers(byte_order), markers(byte_order), byte_order=byte_order)
    [(_, body)] = packets_in(changed(WrongCounts.model_validate({"field": field}), good))
    assert len(body) == len(good) - 8
    for order in ("big", "little"):
        with pytest.raises(FrameError):
            split_frame(body, order)


FRAME_KINDS = [kind for kind in KINDS.values() if kind.__module__.endswith("frame_faults")]


@pytest.mark.parametrize("kind", FRAME_KINDS)
@pytest.mark.parametrize(
    "data",
    [packet(COMMAND, b"OK-Version 1.0"), packet(4), packet(DATA, b"no frame"), packet(2, b"<x/>"), b"half"],
)
def test_faults_of_frames_do_not_change_other_packets(
    kind: type[LastingConnectionFault], data: bytes
) -> None:
    assert changed(kind(), data) == data
