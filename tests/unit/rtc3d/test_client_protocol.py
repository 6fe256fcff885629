"""Servers' replies in every order that the field notes tell of, and some that they do not."""

import struct

import pytest

from gateway.errors import ClosedError, LinkError
from gateway.rtc3d.client_protocol import (
    Answered,
    ByteOrderMismatch,
    ClientProtocol,
    FileReceived,
    FrameRejected,
    ProtocolEvent,
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
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import Frame, split_frame
from gateway.rtc3d.protocol_state import ProtocolState
from tests.servers import error, ok, packet
from tests.vectors import EMPTY_FRAME, FULL_FRAME, START_RECORDING, STOP_RECORDING

STREAM = StreamFrames(AllFrames(), (ComponentType.MARKERS,))


def xml(*sections: str) -> bytes:
    inside = "".join(f"<{section}/>" for section in sections)
    return packet(2, f"<RT_Parameters Ver='1.00'>{inside}</RT_Parameters>")


FRAME = packet(3, FULL_FRAME["big"])
NO_DATA = packet(4)


def after(*commands: Command) -> ClientProtocol:
    """Return a connection on which each command was sent and, but for the last, answered."""
    connection = ClientProtocol()
    for command in commands[:-1]:
        connection.send(command)
        connection.receive(ok(f"OK-{command}"))
    connection.send(commands[-1])
    connection.bytes_to_send()
    return connection


def answers(received: tuple[list[Frame], list[ProtocolEvent]]) -> list[Command]:
    _, events = received
    return [event.command for event in events if isinstance(event, Answered)]


def test_a_command_goes_out_as_a_packet_of_type_1() -> None:
    connection = ClientProtocol()
    connection.send(Version())
    assert connection.bytes_to_send() == b"\x00\x00\x00\x13\x00\x00\x00\x01Version 1.0"
    assert connection.bytes_to_send() == b""


@pytest.mark.parametrize("text", ["OK-Version 1.0", "version 1.0", "ok-version", "OK", "", "Version 1.0\0\0"])
def test_any_type_1_text_accepts(text: str) -> None:
    connection = after(Version())
    assert answers(connection.receive(ok(text))) == [Version()]
    assert connection.pending_command is None


@pytest.mark.parametrize("text", ["Error-Wrong version", "err-unknown", "OK-Version 1.0", ""])
def test_any_type_0_text_refuses(text: str) -> None:
    _, [refused] = after(Version()).receive(error(text))
    assert isinstance(refused, Refused)
    assert refused.command == Version()
    assert str(refused.error) == (text or "no reason given")


def test_a_reply_that_nobody_waits_for_is_stray() -> None:
    _, [event] = ClientProtocol().receive(ok("hello"))
    assert isinstance(event, UnexpectedPacket)


@pytest.mark.parametrize("double", ["OK-Version 1.0", "version 1.0", "ok-version"])
def test_a_doubled_acknowledgement_does_not_answer_the_next_command(double: str) -> None:
    connection = after(Version())
    connection.receive(ok(double))
    connection.send(SetByteOrder("little"))
    assert answers(connection.receive(ok(double))) == []
    _, [refused] = connection.receive(error("err-no"))
    assert isinstance(refused, Refused)
    assert refused.command == SetByteOrder("little")


def test_a_doubled_acknowledgement_without_a_name_in_one_segment_is_stray() -> None:
    connection = after(Version())
    _, [first, second] = connection.receive(ok("OK") + ok("OK"))
    assert isinstance(first, Answered)
    assert isinstance(second, UnexpectedPacket)


def test_a_doubled_start_does_not_answer_stop() -> None:
    connection = after(STREAM)
    connection.receive(ok(f"OK-{STREAM}"))
    connection.send(StopStreaming())
    assert answers(connection.receive(ok(f"OK-{STREAM}"))) == []
    assert answers(connection.receive(ok("OK-StreamFrames Stop"))) == [StopStreaming()]


def test_a_late_reply_is_not_handed_to_the_next_command() -> None:
    connection = after(Version())
    connection.give_up()
    connection.send(SetByteOrder("little"))
    assert answers(connection.receive(ok("OK-Version 1.0"))) == []
    assert answers(connection.receive(ok("OK-SetByteOrder LittleEndian"))) == [SetByteOrder("little")]


def test_a_late_reply_without_a_name_goes_to_nobody() -> None:
    connection = after(Version())
    connection.give_up()
    connection.send(SetByteOrder("little"))
    assert answers(connection.receive(ok("OK"))) == []
    assert answers(connection.receive(ok("OK"))) == [SetByteOrder("little")]


def test_a_late_refusal_is_not_handed_to_the_next_command() -> None:
    connection = after(Version())
    connection.give_up()
    connection.send(SendParameters())
    _, [event] = connection.receive(error("err-unknown command"))
    assert isinstance(event, UnexpectedPacket)
    assert answers(connection.receive(xml("The_3D"))) == [SendParameters()]


def test_a_missing_reply_does_not_shift_those_that_follow() -> None:
    connection = after(Version())
    connection.give_up()
    for command in (SetByteOrder("little"), STREAM, StopStreaming()):
        connection.send(command)
        assert answers(connection.receive(ok(f"OK-{command}"))) == [command]


def test_what_is_owed_is_settled_by_an_answer_that_names_a_later_command() -> None:
    connection = after(Version())
    connection.give_up()
    connection.send(SetByteOrder("little"))
    connection.receive(ok("OK-SetByteOrder LittleEndian"))
    connection.send(STREAM)
    assert answers(connection.receive(ok("OK"))) == [STREAM]


def test_parameters_are_answered_by_xml_only() -> None:
    connection = after(SendParameters(("3d",)))
    assert answers(connection.receive(ok("OK-SendParameters 3D"))) == []
    assert answers(connection.receive(xml("The_3D"))) == [SendParameters(("3d",))]


def test_frames_may_come_between_a_command_and_its_reply() -> None:
    connection = after(STREAM, SendParameters())
    frames, events = connection.receive(FRAME + FRAME + xml("The_3D") + FRAME)
    assert len(frames) == 3
    assert [type(event) for event in events] == [Answered]


def test_late_xml_is_not_handed_to_another_question() -> None:
    connection = after(SendParameters(("3d",)))
    connection.give_up()
    connection.send(SendParameters(("6d",)))
    assert answers(connection.receive(xml("The_3D"))) == []
    assert answers(connection.receive(xml("The_6D"))) == [SendParameters(("6d",))]


def test_a_server_that_sends_all_sections_whatever_is_asked_is_understood() -> None:
    connection = after(SendParameters())
    connection.receive(xml("The_3D", "The_6D"))
    connection.send(SendParameters(("general",)))
    assert answers(connection.receive(xml("The_3D", "The_6D"))) == [SendParameters(("general",))]


def test_missing_xml_does_not_shift_the_next() -> None:
    connection = after(SendParameters(("3d",)))
    connection.give_up()
    connection.send(SendParameters(("6d",)))
    assert answers(connection.receive(xml("The_6D"))) == [SendParameters(("6d",))]


def test_late_xml_answers_the_same_question_asked_again() -> None:
    connection = after(SendParameters())
    connection.give_up()
    connection.send(SendParameters())
    assert answers(connection.receive(xml("The_6D"))) == [SendParameters()]


def test_xml_that_nobody_waits_for_settles_what_is_owed() -> None:
    connection = after(SendParameters(("3d",)))
    connection.give_up()
    _, [event] = connection.receive(xml("The_3D"))
    assert isinstance(event, UnexpectedPacket)
    connection.send(SendParameters(("6d",)))
    assert answers(connection.receive(xml("The_3D"))) == [SendParameters(("6d",))]


@pytest.mark.parametrize("acknowledged", ["before", "between", "after"])
def test_stream_frames_is_acknowledged_at_any_time(acknowledged: str) -> None:
    parts = {
        "before": ok(f"OK-{STREAM}") + FRAME + FRAME,
        "between": FRAME + ok(f"OK-{STREAM}") + FRAME,
        "after": FRAME + FRAME + ok(f"OK-{STREAM}"),
    }
    connection = after(STREAM)
    frames, events = connection.receive(parts[acknowledged])
    assert answers((frames, events)) == [STREAM]
    assert len(frames) == 2
    assert connection.state is ProtocolState.STREAMING


def test_frames_in_flight_do_not_accept_a_change_of_rate() -> None:
    connection = after(STREAM)
    connection.receive(FRAME)
    connection.receive(ok(f"OK-{STREAM}"))
    connection.send(StreamFrames(AllFrames()))
    assert answers(connection.receive(FRAME)) == []
    _, [refused] = connection.receive(error("err-no"))
    assert isinstance(refused, Refused)
    assert connection.state is ProtocolState.STREAMING


def test_the_current_frame_comes_after_an_acknowledgement() -> None:
    connection = after(SendCurrentFrame())
    assert answers(connection.receive(ok("OK-SendCurrentFrame"))) == []
    assert answers(connection.receive(FRAME)) == [SendCurrentFrame()]


def test_the_current_frame_comes_alone() -> None:
    assert answers(after(SendCurrentFrame()).receive(FRAME)) == [SendCurrentFrame()]


def test_no_data_answers_a_request_for_the_current_frame() -> None:
    connection = after(SendCurrentFrame())
    _, [answered] = connection.receive(packet(4, "no measurement"))
    assert isinstance(answered, Answered)
    assert answered.packet.body == b"no measurement"


def test_a_streamed_frame_without_the_component_is_not_the_current_frame() -> None:
    markers_only = packet(3, struct.pack(">IIIiqI", 1, 24, 1, 5, 0, 0))
    connection = after(STREAM)
    connection.receive(FRAME)
    connection.send(SendCurrentFrame((ComponentType.ANALOG,)))
    assert answers(connection.receive(markers_only)) == []
    assert answers(connection.receive(FRAME)) == [SendCurrentFrame((ComponentType.ANALOG,))]


def test_the_current_frame_is_no_part_of_a_stream_that_does_not_run() -> None:
    connection = after(SendCurrentFrame())
    frames, events = connection.receive(FRAME)
    assert (frames, [type(event) for event in events]) == ([], [Answered])
    assert connection.state is ProtocolState.IDLE


def test_states_of_a_measurement() -> None:
    connection = ClientProtocol()
    seen = [connection.state]

    def note(data: bytes = b"") -> None:
        connection.receive(data)
        seen.append(connection.state)

    connection.send(STREAM)
    note()
    note(ok(f"OK-{STREAM}"))
    note(NO_DATA)
    note(FRAME)
    note(NO_DATA)
    connection.send(StopStreaming())
    note(ok("OK-StreamFrames Stop"))
    connection.send(Bye())
    note()
    connection.end()
    note()
    assert seen == [
        ProtocolState.IDLE,
        ProtocolState.REQUESTED,
        ProtocolState.REQUESTED,
        ProtocolState.NO_MEASUREMENT,
        ProtocolState.STREAMING,
        ProtocolState.NO_MEASUREMENT,
        ProtocolState.IDLE,
        ProtocolState.CLOSING,
        ProtocolState.CLOSED,
    ]


def test_a_refused_stream_leaves_the_connection_idle() -> None:
    connection = after(STREAM)
    connection.receive(error("err-unknown parameter 3D"))
    assert connection.state is ProtocolState.IDLE


def test_recording_control_is_the_packet_of_field_note_16() -> None:
    connection = ClientProtocol()
    connection.send_recording(start=False)
    assert connection.bytes_to_send() == STOP_RECORDING


def test_recording_control_goes_in_the_byte_order_of_the_session() -> None:
    connection = after(SetByteOrder("little"))
    connection.receive(ok("OK-SetByteOrder LittleEndian"))
    connection.send_recording(start=True)
    assert connection.bytes_to_send() == START_RECORDING


def test_nothing_is_sent_after_bye_or_the_end() -> None:
    connection = after(Bye())
    with pytest.raises(ClosedError, match="closing"):
        connection.send(Version())
    connection.end()
    with pytest.raises(ClosedError, match="closed"):
        connection.send(Bye())


def test_one_command_at_a_time() -> None:
    connection = after(Version())
    with pytest.raises(LinkError, match=r"Version 1\.0 has not been answered yet"):
        connection.send(SendParameters())


@pytest.mark.parametrize("reply", [b"", ok("bye"), ok("OK-Bye"), FRAME + ok("bye")])
def test_bye_may_be_answered_or_not(reply: bytes) -> None:
    connection = after(Bye())
    connection.receive(reply)
    assert connection.state is ProtocolState.CLOSING


def test_the_first_frame_shows_the_byte_order_in_use() -> None:
    connection = after(SetByteOrder("little"), STREAM)
    frames, events = connection.receive(FRAME + FRAME)
    assert len(frames) == 2
    assert {type(event) for event in events} == {Answered, ByteOrderMismatch}
    assert connection.byte_order == "big"


def test_the_agreed_byte_order_is_used_without_a_warning() -> None:
    connection = after(SetByteOrder("little"), STREAM)
    _, events = connection.receive(packet(3, FULL_FRAME["little"]))
    assert not any(isinstance(event, ByteOrderMismatch) for event in events)
    assert connection.byte_order == "little"


def test_a_refused_byte_order_is_not_expected() -> None:
    connection = after(SetByteOrder("little"))
    connection.receive(error("err-no"))
    connection.send(STREAM)
    _, events = connection.receive(FRAME)
    assert not any(isinstance(event, ByteOrderMismatch) for event in events)


def test_a_frame_without_components_does_not_settle_the_byte_order() -> None:
    connection = after(STREAM)
    connection.receive(packet(3, EMPTY_FRAME["big"]))
    assert connection.byte_order is None
    connection.receive(packet(3, FULL_FRAME["little"]))
    assert connection.byte_order == "little"


def test_a_bad_frame_is_rejected_and_the_next_one_taken() -> None:
    connection = after(STREAM)
    connection.receive(FRAME)
    frames, events = connection.receive(packet(3, FULL_FRAME["big"][:-4]) + FRAME)
    assert len(frames) == 1
    assert [type(event) for event in events] == [FrameRejected]


def test_a_c3d_file_is_handed_over_whole() -> None:
    assert ClientProtocol().receive(packet(5, b"C3D")) == ([], [FileReceived(b"C3D")])


def test_an_unknown_packet_type_is_stray() -> None:
    _, [event] = ClientProtocol().receive(packet(77, b"?"))
    assert isinstance(event, UnexpectedPacket)


def test_a_size_out_of_bounds_ends_the_connection_after_what_came_before() -> None:
    connection = after(STREAM)
    frames, events = connection.receive(FRAME + b"HTTP/1.1 400 Bad Request\r\n")
    assert len(frames) == 1
    assert isinstance(events[-1], StreamCorrupted)
    assert "1213486160" in str(events[-1].error)  # "HTTP"
    assert connection.state is ProtocolState.CLOSED
    assert connection.receive(FRAME) == ([], [])


# Frames after the first of their layout --------------------------------------------------------


def test_a_known_frame_after_no_data_is_streaming_again() -> None:
    connection = after(STREAM)
    connection.receive(FRAME + NO_DATA)
    states = [connection.state]
    [_], [] = connection.receive(FRAME)
    assert [*states, connection.state] == [ProtocolState.NO_MEASUREMENT, ProtocolState.STREAMING]


def test_the_error_of_a_broken_stream_has_its_offset_after_known_frames() -> None:
    connection = after(STREAM)
    connection.receive(FRAME)
    frames, [broken] = connection.receive(FRAME + FRAME + bytes(8))
    assert len(frames) == 2
    assert isinstance(broken, StreamCorrupted)
    assert broken.error.offset == 3 * len(FRAME)


@pytest.mark.parametrize("first", [1, 7, 8, 12, len(FRAME) - 1])
def test_a_known_frame_in_pieces_is_the_same_frame_and_the_stream_goes_on_behind_it(first: int) -> None:
    connection = after(STREAM)
    connection.receive(FRAME)
    assert connection.receive(FRAME[:first]) == ([], [])
    frames, [broken] = connection.receive(FRAME[first:] + FRAME + bytes(8))
    expected = split_frame(FULL_FRAME["big"], "big")
    assert [frame.components for frame in frames] == [expected.components] * 2
    assert isinstance(broken, StreamCorrupted)
    assert broken.error.offset == 3 * len(FRAME)


def test_a_packet_in_pieces_as_long_as_the_frame_before_is_read_for_what_it_is() -> None:
    connection = after(STREAM)
    connection.receive(FRAME)
    text = packet(1, b"x" * (len(FRAME) - 8))
    assert connection.receive(text[:20]) == ([], [])
    [_], [event] = connection.receive(text[20:] + FRAME)
    assert isinstance(event, UnexpectedPacket)


def test_a_frame_in_pieces_that_is_asked_for_is_the_answer() -> None:
    connection = after(STREAM)
    connection.receive(FRAME + ok("OK-StreamFrames"))
    connection.send(SendCurrentFrame())
    connection.receive(FRAME[:20])
    assert answers(connection.receive(FRAME[20:])) == [SendCurrentFrame()]
