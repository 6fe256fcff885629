"""The client's side of a connection: what it sends, its states, its events."""

import pytest

from gateway.errors import ClosedError, LinkError
from gateway.rtc3d.client_protocol import (
    ClientProtocol,
    StreamCorrupted,
    UnexpectedPacket,
)
from gateway.rtc3d.commands import (
    Bye,
    SendParameters,
    SetByteOrder,
    StopStreaming,
    Version,
)
from gateway.rtc3d.protocol_state import ProtocolState
from tests.servers import error, ok, packet
from tests.unit.rtc3d.protocols import FRAME, NO_DATA, STREAM, protocol_after
from tests.vectors import START_RECORDING, STOP_RECORDING


def test_a_command_is_sent_as_a_packet_of_type_1() -> None:
    protocol = ClientProtocol()
    protocol.send(Version())
    assert protocol.bytes_to_send() == b"\x00\x00\x00\x13\x00\x00\x00\x01Version 1.0"
    assert protocol.bytes_to_send() == b""


def test_the_states_of_a_connection_through_a_measurement() -> None:
    protocol = ClientProtocol()
    seen = [protocol.state]

    def note(data: bytes = b"") -> None:
        protocol.receive(data)
        seen.append(protocol.state)

    protocol.send(STREAM)
    note()
    note(ok(f"OK-{STREAM}"))
    note(NO_DATA)
    note(FRAME)
    note(NO_DATA)
    protocol.send(StopStreaming())
    note(ok("OK-StreamFrames Stop"))
    protocol.send(Bye())
    note()
    protocol.end()
    note()
    assert seen == [
        ProtocolState.IDLE,
        ProtocolState.REQUESTED,
        ProtocolState.REQUESTED,
        ProtocolState.NO_MEASUREMENT,
        ProtocolState.STREAMING,
        ProtocolState.NO_MEASUREMENT,
        ProtocolState.STOPPED,
        ProtocolState.CLOSING,
        ProtocolState.CLOSED,
    ]


def test_after_a_refused_request_for_frames_the_connection_is_idle() -> None:
    protocol = protocol_after(STREAM)
    protocol.receive(error("err-unknown parameter 3D"))
    assert protocol.state is ProtocolState.IDLE


def test_recording_control_is_the_data_frame_of_field_note_16() -> None:
    protocol = ClientProtocol()
    protocol.send_recording(start=False)
    assert protocol.bytes_to_send() == STOP_RECORDING


def test_recording_control_has_the_agreed_byte_order() -> None:
    protocol = protocol_after(SetByteOrder("little"))
    protocol.receive(ok("OK-SetByteOrder LittleEndian"))
    protocol.send_recording(start=True)
    assert protocol.bytes_to_send() == START_RECORDING


def test_nothing_can_be_sent_after_bye_or_the_end() -> None:
    protocol = protocol_after(Bye())
    with pytest.raises(ClosedError, match="closing"):
        protocol.send(Version())
    protocol.end()
    with pytest.raises(ClosedError, match="closed"):
        protocol.send(Bye())


def test_a_second_command_cannot_be_sent_while_one_is_pending() -> None:
    protocol = protocol_after(Version())
    with pytest.raises(LinkError, match=r"Version 1\.0 has not been answered yet"):
        protocol.send(SendParameters())


@pytest.mark.parametrize("reply", [b"", ok("bye"), ok("OK-Bye"), FRAME + ok("bye")])
def test_any_answer_to_bye_or_none_leaves_the_connection_closing(reply: bytes) -> None:
    protocol = protocol_after(Bye())
    protocol.receive(reply)
    assert protocol.state is ProtocolState.CLOSING


def test_a_c3d_file_is_returned_in_the_pieces_in_which_it_arrives() -> None:
    protocol, file = ClientProtocol(), packet(5, b"C3D")
    frames, pieces = protocol.receive(FRAME + file[:10])
    later_frames, later_pieces = protocol.receive(file[10:] + FRAME)
    assert [len(frames), len(later_frames)] == [1, 1]
    assert [repr(piece) for piece in pieces + later_pieces] == [
        "FilePiece(b'C3', 0, 3)",
        "FilePiece(b'D', 2, 3)",
    ]


def test_a_packet_of_unknown_type_is_unexpected() -> None:
    _, [event] = ClientProtocol().receive(packet(77, b"?"))
    assert isinstance(event, UnexpectedPacket)


def test_a_size_out_of_bounds_closes_the_connection_after_the_frames_before_it() -> None:
    protocol = protocol_after(STREAM)
    frames, events = protocol.receive(FRAME + b"HTTP/1.1 400 Bad Request\r\n")
    assert len(frames) == 1
    assert isinstance(events[-1], StreamCorrupted)
    assert "1213486160" in str(events[-1].error)  # "HTTP"
    assert protocol.state is ProtocolState.CLOSED
    assert protocol.receive(FRAME) == ([], [])


def test_the_error_of_a_corrupt_stream_has_its_offset() -> None:
    protocol = protocol_after(STREAM)
    protocol.receive(FRAME)
    frames, [corrupted] = protocol.receive(FRAME + FRAME + bytes(8))
    assert len(frames) == 2
    assert isinstance(corrupted, StreamCorrupted)
    assert corrupted.error.offset == 3 * len(FRAME)
