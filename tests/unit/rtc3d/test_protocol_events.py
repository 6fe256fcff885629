"""The content of each event of the client's protocol."""

import numpy as np
import pytest

from gateway.errors import ClosedError, LinkError
from gateway.rtc3d.client_protocol import (
    Answered,
    ByteOrderMismatch,
    ClientProtocol,
    FrameRejected,
    ProtocolEvent,
    Refused,
    StreamCorrupted,
    UnexpectedPacket,
)
from gateway.rtc3d.commands import (
    Bye,
    Command,
    SendCurrentFrame,
    SendParameters,
    SetByteOrder,
    StreamFrames,
    Version,
)
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType, encode_component
from gateway.rtc3d.frames import encode_frame, split_frame
from gateway.rtc3d.packets import Packet
from gateway.rtc3d.protocol_state import ProtocolState
from tests.servers import error, ok, packet
from tests.vectors import FULL_FRAME

FRAME = FULL_FRAME["big"]


def events_after(command: Command, reply: bytes) -> list[ProtocolEvent]:
    connection = ClientProtocol()
    connection.send(command)
    _, events = connection.receive(reply)
    return events


@pytest.mark.parametrize(
    ("command", "packet_type", "body"),
    [
        (Version(), 1, b"OK-Version 1.0"),
        (SendParameters(), 2, b"<RT_Parameters/>"),
        (SendCurrentFrame(), 3, FRAME),
        (SendCurrentFrame(), 4, b"No data"),
        (StreamFrames(), 1, b"ok-streamframes"),
        (StreamFrames(), 3, FRAME),
        (StreamFrames(), 4, b""),
    ],
)
def test_an_answer_carries_the_command_and_the_whole_packet(
    command: Command, packet_type: int, body: bytes
) -> None:
    assert events_after(command, packet(packet_type, body)) == [Answered(command, Packet(packet_type, body))]


@pytest.mark.parametrize("packet_type", [0, 1, 2, 6])
def test_a_packet_that_answers_nothing_is_passed_on_whole(packet_type: int) -> None:
    _, events = ClientProtocol().receive(packet(packet_type, b"what is it"))
    assert events == [UnexpectedPacket(Packet(packet_type, b"what is it"))]


@pytest.mark.parametrize(
    ("reply", "text"),
    [
        ("err-no such command", "err-no such command"),
        ("", "no reason given"),
        ("x" * 300, "x" * 300),
        ("x" * 301, "x" * 300),
    ],
    ids=["a reason", "no reason", "300 bytes", "301 bytes"],
)
def test_a_refusal_carries_the_command_and_at_most_300_bytes_of_the_servers_text(
    reply: str, text: str
) -> None:
    [refused] = events_after(Version(), error(reply))
    assert isinstance(refused, Refused)
    assert refused.command == Version()
    assert str(refused.error) == text


def test_a_rejected_frame_carries_the_contradiction() -> None:
    _, [rejected] = ClientProtocol().receive(packet(3, b"\0\0\0"))
    assert isinstance(rejected, FrameRejected)
    assert str(rejected.error) == "data frame of 3 bytes: too short for its component count"


def test_a_mismatch_carries_the_byte_order_of_the_frames() -> None:
    _, events = ClientProtocol().receive(packet(3, FULL_FRAME["little"]))
    assert events == [ByteOrderMismatch("little")]


def test_a_command_that_cannot_be_sent_is_named_with_the_reason() -> None:
    connection = ClientProtocol()
    connection.send(Version())
    with pytest.raises(LinkError) as waiting:
        connection.send(SetByteOrder("little"))
    connection.send(Bye())
    with pytest.raises(ClosedError) as closing:
        connection.send(Version())
    connection.end()
    with pytest.raises(ClosedError) as closed:
        connection.send_recording(start=True)
    assert [str(caught.value) for caught in (waiting, closing, closed)] == [
        "SetByteOrder LittleEndian not sent: Version 1.0 has not been answered yet",
        "Version 1.0 not sent: the connection is closing",
        "recording control not sent: the connection is closed",
    ]


def test_a_frame_that_is_not_streamed_is_the_answer_alone() -> None:
    connection = ClientProtocol()
    connection.send(SendCurrentFrame())
    frames, _ = connection.receive(packet(3, FRAME))
    assert frames == []
    connection.send(StreamFrames())
    connection.receive(ok("ok"))
    frames, events = connection.receive(packet(3, FRAME))
    assert [frame.body for frame in frames] == [FRAME]
    assert events == []


def test_a_current_frame_without_the_requested_component_is_the_answer_while_nothing_is_streamed() -> None:
    command = SendCurrentFrame((ComponentType.MARKERS,))
    body = encode_frame([encode_component(ComponentType.ANALOG, 1, 0, np.zeros(1, ">f4"))])
    assert events_after(command, packet(3, body)) == [Answered(command, Packet(3, body))]


def test_an_error_that_begins_with_another_commands_name_refuses_the_pending_command() -> None:
    [refused] = events_after(SetByteOrder("little"), error("Version must be sent first"))
    assert isinstance(refused, Refused)
    assert refused.command == SetByteOrder("little")


def test_an_acknowledgement_by_name_passes_over_an_earlier_command_without_a_reply() -> None:
    connection = ClientProtocol()
    connection.send(Version())
    connection.give_up()
    connection.send(SetByteOrder("little"))
    _, events = connection.receive(packet(1, b"ok-setbyteorder"))
    assert events == [Answered(SetByteOrder("little"), Packet(1, b"ok-setbyteorder"))]


@pytest.mark.parametrize(("packet_type", "limit"), [(2, 100), (5, 200)])
def test_packets_are_bounded_by_the_limit_of_their_type(packet_type: int, limit: int) -> None:
    connection = ClientProtocol(max_packet_bytes=100, max_c3d_bytes=200)
    connection.receive(packet(packet_type, bytes(limit - 8)))
    assert connection.state is ProtocolState.IDLE
    _, [corrupted] = connection.receive(packet(packet_type, bytes(limit - 7)))
    assert isinstance(corrupted, StreamCorrupted)
    assert corrupted.error.size == limit + 1


def test_the_first_known_component_gives_a_layout_its_type() -> None:
    markers = encode_component(ComponentType.MARKERS, 1, 0, np.zeros(1, ITEM_DTYPES[ComponentType.MARKERS]))
    unknown = bytes.fromhex("0000000c 00000063 00000000")
    types = [
        split_frame(encode_frame(components), "big").layout.first_component_type
        for components in ([markers], [unknown, markers], [unknown], [])
    ]
    assert types == [ComponentType.MARKERS, ComponentType.MARKERS, None, None]
