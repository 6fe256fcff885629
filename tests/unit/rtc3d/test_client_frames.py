"""Frames among other packets: which are streamed, which are answers, and their byte order."""

import struct

import pytest

from gateway.rtc3d.client_protocol import (
    Answered,
    ByteOrderMismatch,
    FrameRejected,
    Refused,
    StreamCorrupted,
    UnexpectedPacket,
)
from gateway.rtc3d.commands import (
    AllFrames,
    SendCurrentFrame,
    SendParameters,
    SetByteOrder,
    StreamFrames,
)
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import split_frame
from gateway.rtc3d.protocol_state import ProtocolState
from tests.servers import error, ok, packet
from tests.unit.rtc3d.protocols import FRAME, NO_DATA, STREAM, answers, protocol_after, xml
from tests.vectors import EMPTY_FRAME, FULL_FRAME


def test_frames_may_arrive_between_a_command_and_its_reply() -> None:
    protocol = protocol_after(STREAM, SendParameters())
    frames, events = protocol.receive(FRAME + FRAME + xml("The_3D") + FRAME)
    assert len(frames) == 3
    assert [type(event) for event in events] == [Answered]


@pytest.mark.parametrize("acknowledged", ["before", "between", "after"])
def test_stream_frames_may_be_acknowledged_before_between_or_after_frames(acknowledged: str) -> None:
    orders = {
        "before": ok(f"OK-{STREAM}") + FRAME + FRAME,
        "between": FRAME + ok(f"OK-{STREAM}") + FRAME,
        "after": FRAME + FRAME + ok(f"OK-{STREAM}"),
    }
    protocol = protocol_after(STREAM)
    frames, events = protocol.receive(orders[acknowledged])
    assert answers((frames, events)) == [STREAM]
    assert len(frames) == 2
    assert protocol.state is ProtocolState.STREAMING


def test_a_streamed_frame_does_not_accept_a_new_rate() -> None:
    protocol = protocol_after(STREAM)
    protocol.receive(FRAME)
    protocol.receive(ok(f"OK-{STREAM}"))
    protocol.send(StreamFrames(AllFrames()))
    assert answers(protocol.receive(FRAME)) == []
    _, [refused] = protocol.receive(error("err-no"))
    assert isinstance(refused, Refused)
    assert protocol.state is ProtocolState.STREAMING


def test_the_current_frame_may_follow_an_acknowledgement() -> None:
    protocol = protocol_after(SendCurrentFrame())
    assert answers(protocol.receive(ok("OK-SendCurrentFrame"))) == []
    assert answers(protocol.receive(FRAME)) == [SendCurrentFrame()]


def test_the_current_frame_may_arrive_without_an_acknowledgement() -> None:
    assert answers(protocol_after(SendCurrentFrame()).receive(FRAME)) == [SendCurrentFrame()]


def test_no_data_answers_a_request_for_the_current_frame() -> None:
    protocol = protocol_after(SendCurrentFrame())
    _, [answered] = protocol.receive(packet(4, "no measurement"))
    assert isinstance(answered, Answered)
    assert answered.packet.body == b"no measurement"


def test_a_streamed_frame_without_the_component_is_not_the_current_frame() -> None:
    markers_only = packet(3, struct.pack(">IIIiqI", 1, 24, 1, 5, 0, 0))
    protocol = protocol_after(STREAM)
    protocol.receive(FRAME)
    protocol.send(SendCurrentFrame((ComponentType.ANALOG,)))
    assert answers(protocol.receive(markers_only)) == []
    assert answers(protocol.receive(FRAME)) == [SendCurrentFrame((ComponentType.ANALOG,))]


def test_the_current_frame_is_not_returned_as_a_streamed_frame() -> None:
    protocol = protocol_after(SendCurrentFrame())
    frames, events = protocol.receive(FRAME)
    assert (frames, [type(event) for event in events]) == ([], [Answered])
    assert protocol.state is ProtocolState.IDLE


def test_the_first_frame_decides_the_byte_order() -> None:
    protocol = protocol_after(SetByteOrder("little"), STREAM)
    frames, events = protocol.receive(FRAME + FRAME)
    assert len(frames) == 2
    assert {type(event) for event in events} == {Answered, ByteOrderMismatch}
    assert protocol.byte_order == "big"


def test_a_frame_in_the_agreed_byte_order_is_no_mismatch() -> None:
    protocol = protocol_after(SetByteOrder("little"), STREAM)
    _, events = protocol.receive(packet(3, FULL_FRAME["little"]))
    assert not any(isinstance(event, ByteOrderMismatch) for event in events)
    assert protocol.byte_order == "little"


def test_a_refused_byte_order_is_not_the_agreed_one() -> None:
    protocol = protocol_after(SetByteOrder("little"))
    protocol.receive(error("err-no"))
    protocol.send(STREAM)
    _, events = protocol.receive(FRAME)
    assert not any(isinstance(event, ByteOrderMismatch) for event in events)


def test_a_frame_without_components_does_not_decide_the_byte_order() -> None:
    protocol = protocol_after(STREAM)
    protocol.receive(packet(3, EMPTY_FRAME["big"]))
    assert protocol.byte_order is None
    protocol.receive(packet(3, FULL_FRAME["little"]))
    assert protocol.byte_order == "little"


def test_a_bad_frame_is_rejected_and_the_next_one_is_returned() -> None:
    protocol = protocol_after(STREAM)
    protocol.receive(FRAME)
    frames, events = protocol.receive(packet(3, FULL_FRAME["big"][:-4]) + FRAME)
    assert len(frames) == 1
    assert [type(event) for event in events] == [FrameRejected]


def test_a_frame_after_no_data_means_streaming_again() -> None:
    protocol = protocol_after(STREAM)
    protocol.receive(FRAME + NO_DATA)
    states = [protocol.state]
    [_], [] = protocol.receive(FRAME)
    assert [*states, protocol.state] == [ProtocolState.NO_MEASUREMENT, ProtocolState.STREAMING]


@pytest.mark.parametrize("first", [1, 7, 8, 12, len(FRAME) - 1])
def test_a_frame_in_two_reads_is_the_same_frame_and_packets_follow_it(first: int) -> None:
    protocol = protocol_after(STREAM)
    protocol.receive(FRAME)
    assert protocol.receive(FRAME[:first]) == ([], [])
    frames, [corrupted] = protocol.receive(FRAME[first:] + FRAME + bytes(8))
    expected = split_frame(FULL_FRAME["big"], "big")
    assert [frame.components for frame in frames] == [expected.components] * 2
    assert isinstance(corrupted, StreamCorrupted)
    assert corrupted.error.offset == 3 * len(FRAME)


def test_a_text_in_two_reads_that_is_as_long_as_a_frame_is_not_a_frame() -> None:
    protocol = protocol_after(STREAM)
    protocol.receive(FRAME)
    text = packet(1, b"x" * (len(FRAME) - 8))
    assert protocol.receive(text[:20]) == ([], [])
    [_], [event] = protocol.receive(text[20:] + FRAME)
    assert isinstance(event, UnexpectedPacket)


def test_the_current_frame_may_arrive_in_two_reads() -> None:
    protocol = protocol_after(STREAM)
    protocol.receive(FRAME + ok("OK-StreamFrames"))
    protocol.send(SendCurrentFrame())
    protocol.receive(FRAME[:20])
    assert answers(protocol.receive(FRAME[20:])) == [SendCurrentFrame()]
