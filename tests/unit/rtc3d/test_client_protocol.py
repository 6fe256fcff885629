"""The client's side of a connection: what it sends, its states, its frames and its events."""

import struct

import numpy as np
import pytest

from gateway.errors import ClosedError, LinkError
from gateway.rtc3d.client_protocol import (
    Answered,
    ByteOrderMismatch,
    ClientProtocol,
    FrameRejected,
    ProtocolState,
    Refused,
    StreamCorrupted,
    UnexpectedPacket,
)
from gateway.rtc3d.commands import (
    AllFrames,
    Bye,
    Command,
    SendCurrentFrame,
    SendParameters,
    SetByteOrder,
    StopStreaming,
    StreamFrames,
    Version,
)
from gateway.rtc3d.components import ComponentType, encode_component
from gateway.rtc3d.frames import encode_frame, split_frame
from gateway.rtc3d.packets import Packet
from tests.support.errors import names
from tests.support.servers import error, ok, packet
from tests.support.vectors import EMPTY_FRAME, FULL_FRAME, START_RECORDING, STOP_RECORDING, ByteOrder

STREAM = StreamFrames(AllFrames(), (ComponentType.MARKERS,))
FRAME = packet(3, FULL_FRAME["big"])
NO_DATA = packet(4)
ANALOG_ONLY = encode_frame([encode_component(ComponentType.ANALOG, 1, 0, np.zeros(1, ">f4"))])


def protocol_after(command: Command) -> ClientProtocol:
    """Return a protocol that has sent the command."""
    protocol = ClientProtocol()
    protocol.send(command)
    protocol.bytes_to_send()
    return protocol


# Sending --------------------------------------------------------------------------------------


def test_a_command_is_sent_once_as_a_packet_of_type_1() -> None:
    protocol = ClientProtocol()
    protocol.send(Version())
    sent = b"\x00\x00\x00\x13\x00\x00\x00\x01Version 1.0"
    assert (protocol.bytes_to_send(), protocol.bytes_to_send()) == (sent, b"")


def test_recording_control_is_the_data_frame_of_field_note_16() -> None:
    """It is the only data frame that a client sends, in the byte order that was agreed."""
    protocol = ClientProtocol()
    protocol.send_recording(start=False)
    assert protocol.bytes_to_send() == STOP_RECORDING
    protocol = protocol_after(SetByteOrder("little"))
    protocol.receive(ok("OK-SetByteOrder LittleEndian"))
    protocol.send_recording(start=True)
    assert protocol.bytes_to_send() == START_RECORDING


def test_a_command_that_cannot_be_sent_is_named_with_the_reason() -> None:
    """Two commands at once could not be told apart by their replies, and after Bye nobody answers."""
    protocol = protocol_after(Version())
    with pytest.raises(LinkError) as waiting:
        protocol.send(SetByteOrder("little"))
    protocol.send(Bye())
    with pytest.raises(ClosedError) as closing:
        protocol.send(Version())
    protocol.end()
    with pytest.raises(ClosedError) as closed:
        protocol.send_recording(start=True)
    assert names(str(waiting.value), "SetByteOrder LittleEndian", "Version 1.0")
    assert names(str(closing.value), "Version 1.0", "closing")
    assert names(str(closed.value), "recording control", "closed")


# States ---------------------------------------------------------------------------------------

STOP, STOP_OK = StopStreaming(), ok("OK-StreamFrames Stop")


@pytest.mark.parametrize(
    ("steps", "states"),
    [
        (
            [STREAM, ok("OK"), NO_DATA, FRAME, NO_DATA, FRAME],
            "requested, requested, no, streaming, no, streaming",
        ),
        (
            [STREAM, FRAME, STOP, STOP_OK, FRAME, Bye(), "end"],
            "requested, streaming, streaming, stopped, stopped, closing, closed",
        ),
        ([STREAM, FRAME, STOP, STOP_OK, STREAM], "requested, streaming, streaming, stopped, requested"),
        ([STREAM, error("no"), FRAME], "requested, idle, streaming"),
        ([STREAM, error("no"), NO_DATA], "requested, idle, no"),
        ([STREAM, FRAME, STOP, error("no"), FRAME], "requested" + ", streaming" * 4),
        ([STREAM, FRAME, STOP, "give up", FRAME], "requested, streaming, streaming, idle, streaming"),
        ([STREAM, FRAME, StreamFrames(), error("no")], "requested, streaming, streaming, streaming"),
        ([SendCurrentFrame(), FRAME], "idle, idle"),
        ([STREAM, "give up", Version(), error("Error-Version?")], "requested" + ", requested" * 3),
        ([SendCurrentFrame(), NO_DATA], "idle, idle"),
        ([STREAM, FRAME + ok("OK"), SendCurrentFrame(), NO_DATA], "requested, streaming, streaming, no"),
        ([Bye(), ok("bye"), FRAME, NO_DATA], "closing, closing, closing, closing"),
        (["end", NO_DATA], "closed, closed"),
    ],
)
def test_the_state_follows_what_the_server_sends(steps: list[Command | bytes | str], states: str) -> None:
    """Status messages and reconnections depend on it; frames show the truth where replies do not."""
    protocol, seen = ClientProtocol(), []
    for step in steps:
        if isinstance(step, bytes):
            protocol.receive(step)
        elif step == "end":
            protocol.end()
        elif step == "give up":
            protocol.give_up()
        elif not isinstance(step, str):
            protocol.send(step)
        seen.append(protocol.state.value.removesuffix(" measurement"))
    assert ", ".join(seen) == states


# Frames ---------------------------------------------------------------------------------------


def test_the_current_frame_is_the_answer_alone_while_nothing_is_streamed() -> None:
    """Published as a streamed frame, it would count as the stream's first one."""
    for body in (FULL_FRAME["big"], ANALOG_ONLY, EMPTY_FRAME["big"]):
        command = SendCurrentFrame((ComponentType.MARKERS,))
        assert protocol_after(command).receive(packet(3, body)) == ([], [Answered(command, Packet(3, body))])


@pytest.mark.parametrize(
    ("requested", "answers"),
    [
        ((ComponentType.ANALOG,), [False, True]),
        ((ComponentType.ANALOG, ComponentType.MARKERS), [True, False]),
        ((), [True, False]),
    ],
)
def test_a_fitting_streamed_frame_answers(requested: tuple[ComponentType, ...], answers: list[bool]) -> None:
    """Frames of a running stream arrive between the request and its answer, which may be an empty frame."""
    markers_only = packet(3, struct.pack(">IIIiqI", 1, 24, 1, 5, 0, 0))
    for stream, expected in (((markers_only, FRAME), answers), ((packet(3, EMPTY_FRAME["big"]),), [True])):
        protocol = protocol_after(STREAM)
        protocol.receive(FRAME)
        protocol.send(SendCurrentFrame(requested))
        received = [protocol.receive(body) for body in stream]
        assert [len(frames) for frames, _ in received] == [1] * len(stream)
        assert [bool(events) for _, events in received] == expected


@pytest.mark.parametrize(
    ("reply", "sent", "is_mismatch"),
    [
        *((ok("OK"), "big", True), (ok("OK"), "little", False)),
        *((error("no"), "big", False), (error("no"), "little", True)),
    ],
)
def test_the_first_components_decide_the_byte_order(reply: bytes, sent: ByteOrder, is_mismatch: bool) -> None:
    """A server may acknowledge a byte order and ignore it (field note 4); an empty frame shows neither."""
    protocol = protocol_after(SetByteOrder("little"))
    protocol.receive(reply)
    protocol.send(STREAM)
    protocol.receive(packet(3, EMPTY_FRAME["big"]))
    assert protocol.byte_order is None
    frames, events = protocol.receive(packet(3, FULL_FRAME[sent]) * 2)
    assert [frame.components for frame in frames] == [split_frame(FULL_FRAME[sent], sent).components] * 2
    assert events == [ByteOrderMismatch(sent)] * is_mismatch
    assert protocol.byte_order == sent


@pytest.mark.parametrize("order", ["big", "little"])
def test_a_frame_that_contradicts_itself_is_rejected_and_the_next_one_returned(order: ByteOrder) -> None:
    """The event says how many components the frame announces in the byte order of this connection."""
    protocol = protocol_after(STREAM)
    good = packet(3, FULL_FRAME[order])
    protocol.receive(good)
    frames, [rejected] = protocol.receive(packet(3, FULL_FRAME[order][:-4]) + good)
    assert len(frames) == 1
    assert isinstance(rejected, FrameRejected)
    assert rejected.num_components == 5
    assert "type 5" in str(rejected.error)


@pytest.mark.parametrize("first", [1, 7, 8, 12, len(FRAME) - 1])
def test_the_offset_of_a_fault_counts_every_byte_of_frames_in_two_reads(first: int) -> None:
    protocol = protocol_after(STREAM)
    protocol.receive(FRAME)
    assert protocol.receive(FRAME[:first]) == ([], [])
    frames, [corrupted] = protocol.receive(FRAME[first:] + FRAME + bytes(8))
    assert len(frames) == 2
    assert isinstance(corrupted, StreamCorrupted)
    assert corrupted.error.offset == 3 * len(FRAME)


def test_frames_are_received_in_parts_while_there_are_more() -> None:
    """A burst is handled in several turns of the event loop, in order and without loss."""
    protocol = protocol_after(STREAM)
    frames, events = protocol.receive(FRAME * 5 + ok("OK"), 2)
    counts = [len(frames)]
    while protocol.has_more:
        frames, events = protocol.receive(b"", 2)
        counts.append(len(frames))
    assert (counts, [type(event) for event in events]) == ([2, 2, 1], [UnexpectedPacket])


# Events ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "packet_type", "body"),
    [
        (Version(), 1, b"OK-Version 1.0"),
        (SendParameters(), 2, b"<RT_Parameters/>"),
        (SendCurrentFrame(), 4, b"No data"),
        (StreamFrames(), 1, b"ok-streamframes"),
        (StreamFrames(), 3, FULL_FRAME["big"]),
        (StreamFrames(), 4, b""),
    ],
)
def test_an_answer_has_the_command_and_the_packet(command: Command, packet_type: int, body: bytes) -> None:
    _, events = protocol_after(command).receive(packet(packet_type, body))
    assert events == [Answered(command, Packet(packet_type, body))]


@pytest.mark.parametrize("packet_type", [0, 1, 2, 6, 77])
def test_a_packet_that_answers_nothing_is_passed_on_whole(packet_type: int) -> None:
    """The log shows what a server sends unasked."""
    _, events = ClientProtocol().receive(packet(packet_type, b"what is it"))
    assert events == [UnexpectedPacket(Packet(packet_type, b"what is it"))]


@pytest.mark.parametrize(
    ("reply", "text"),
    [("err-no", "err-no"), ("", "no reason given"), ("x" * 301, "x" * 300), ("a\x1bb", r"a\x1bb")],
)
def test_a_refusal_carries_at_most_300_bytes_of_the_servers_text(reply: str, text: str) -> None:
    """The text goes into logs and status messages, so it is bounded and printable."""
    _, [refused] = protocol_after(Version()).receive(error(reply))
    assert isinstance(refused, Refused)
    assert (refused.command, str(refused.error)) == (Version(), text)


def test_a_c3d_file_is_returned_in_the_pieces_in_which_it_arrives() -> None:
    """Frames go on between the packets of a file, and the pieces keep their order."""
    protocol, file = ClientProtocol(), packet(5, b"C3D")
    received = [protocol.receive(each) for each in (FRAME + file[:10], file[10:] + FRAME)]
    pieces = [(len(frames), repr(piece)) for frames, [piece] in received]
    assert pieces == [(1, "FilePiece(b'C3', 0, 3)"), (1, "FilePiece(b'D', 2, 3)")]


def test_a_size_out_of_bounds_closes_the_connection_after_the_frames_before_it() -> None:
    """What follows cannot be read, so nothing more is taken from this connection."""
    protocol = protocol_after(STREAM)
    frames, events = protocol.receive(FRAME + b"HTTP/1.1 400 Bad Request\r\n")
    assert len(frames) == 1
    assert isinstance(events[-1], StreamCorrupted)
    assert "1213486160" in str(events[-1].error)  # "HTTP"
    assert protocol.state is ProtocolState.CLOSED
    assert protocol.receive(FRAME) == ([], [])


@pytest.mark.parametrize(("packet_type", "limit"), [(2, 100), (5, 200)])
def test_packets_are_bounded_by_the_limit_of_their_type(packet_type: int, limit: int) -> None:
    """The limits of the configuration reach the reader, each for its own type."""
    protocol = ClientProtocol(max_packet_bytes=100, max_c3d_bytes=200)
    protocol.receive(packet(packet_type, bytes(limit - 8)))
    assert protocol.state is ProtocolState.IDLE
    _, [corrupted] = protocol.receive(packet(packet_type, bytes(limit - 7)))
    assert isinstance(corrupted, StreamCorrupted)
    assert corrupted.error.size == limit + 1
