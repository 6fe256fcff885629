"""Replies to commands, in every order that the field notes describe and in some others."""

import pytest

from gateway.rtc3d.client_protocol import (
    Answered,
    ClientProtocol,
    PossibleReply,
    Refused,
    UnexpectedPacket,
)
from gateway.rtc3d.commands import (
    SendCurrentFrame,
    SendParameters,
    SetByteOrder,
    StopStreaming,
    StreamFrames,
    Version,
)
from gateway.rtc3d.packets import Packet
from gateway.rtc3d.protocol_state import ProtocolState
from tests.servers import error, ok
from tests.unit.rtc3d.protocols import FRAME, NO_DATA, STREAM, answers, protocol_after, xml


@pytest.mark.parametrize("text", ["OK-Version 1.0", "version 1.0", "ok-version", "OK", "", "Version 1.0\0\0"])
def test_any_text_of_type_1_accepts_the_command(text: str) -> None:
    protocol = protocol_after(Version())
    assert answers(protocol.receive(ok(text))) == [Version()]
    assert protocol.pending_command is None


@pytest.mark.parametrize("text", ["Error-Wrong version", "err-unknown", "OK-Version 1.0", ""])
def test_any_text_of_type_0_refuses_the_command(text: str) -> None:
    _, [refused] = protocol_after(Version()).receive(error(text))
    assert isinstance(refused, Refused)
    assert refused.command == Version()
    assert str(refused.error) == (text or "no reason given")


def test_a_reply_without_a_pending_command_is_unexpected() -> None:
    _, [event] = ClientProtocol().receive(ok("hello"))
    assert isinstance(event, UnexpectedPacket)


@pytest.mark.parametrize("double", ["OK-Version 1.0", "version 1.0", "ok-version"])
def test_a_duplicate_acknowledgement_does_not_answer_the_next_command(double: str) -> None:
    protocol = protocol_after(Version())
    protocol.receive(ok(double))
    protocol.send(SetByteOrder("little"))
    assert answers(protocol.receive(ok(double))) == []
    _, [refused] = protocol.receive(error("err-no"))
    assert isinstance(refused, Refused)
    assert refused.command == SetByteOrder("little")


def test_a_duplicate_acknowledgement_that_names_no_command_is_unexpected() -> None:
    protocol = protocol_after(Version())
    _, [first, second] = protocol.receive(ok("OK") + ok("OK"))
    assert isinstance(first, Answered)
    assert isinstance(second, UnexpectedPacket)


def test_a_duplicate_acknowledgement_of_stream_frames_does_not_answer_stop() -> None:
    protocol = protocol_after(STREAM)
    protocol.receive(ok(f"OK-{STREAM}"))
    protocol.send(StopStreaming())
    assert answers(protocol.receive(ok(f"OK-{STREAM}"))) == []
    assert answers(protocol.receive(ok("OK-StreamFrames Stop"))) == [StopStreaming()]


def test_a_late_reply_does_not_answer_the_next_command() -> None:
    protocol = protocol_after(Version())
    protocol.give_up()
    protocol.send(SetByteOrder("little"))
    assert answers(protocol.receive(ok("OK-Version 1.0"))) == []
    assert answers(protocol.receive(ok("OK-SetByteOrder LittleEndian"))) == [SetByteOrder("little")]


def test_a_late_reply_that_names_no_command_answers_nothing() -> None:
    protocol = protocol_after(Version())
    protocol.give_up()
    protocol.send(SetByteOrder("little"))
    assert answers(protocol.receive(ok("OK"))) == []
    assert answers(protocol.receive(ok("OK"))) == [SetByteOrder("little")]


def test_a_refusal_without_a_name_may_be_a_late_one() -> None:
    protocol = protocol_after(Version())
    protocol.give_up()
    protocol.send(SendParameters())
    _, events = protocol.receive(error("err-unknown command"))
    assert events == [PossibleReply(SendParameters())]
    assert answers(protocol.receive(xml("The_3D"))) == [SendParameters()]
    assert protocol.assume_reply() == []


def test_a_refusal_without_a_name_refuses_the_pending_command_if_nothing_else_follows() -> None:
    protocol = protocol_after(Version())
    protocol.give_up()
    protocol.send(STREAM)
    protocol.receive(error("err-unknown command"))
    assert protocol.state.value == "requested"
    [refused] = protocol.assume_reply()
    assert isinstance(refused, Refused)
    assert (refused.command, str(refused.error)) == (STREAM, "err-unknown command")
    assert protocol.state is ProtocolState.IDLE
    assert protocol.assume_reply() == []


def test_a_server_that_ignores_commands_refuses_the_next_form_of_stream_frames_at_once() -> None:
    protocol = protocol_after(Version())
    protocol.give_up()
    protocol.send(STREAM)
    protocol.receive(error("what?"))
    protocol.assume_reply()
    protocol.send(StreamFrames())
    _, [refused] = protocol.receive(error("what?"))
    assert isinstance(refused, Refused)
    assert refused.command == StreamFrames()


def test_as_many_late_refusals_as_commands_refuse_each_its_own() -> None:
    protocol = protocol_after(Version())
    for command in (SendParameters(), STREAM):
        protocol.give_up()
        protocol.send(command)
    _, events = protocol.receive(error("what?") + error("what?"))
    assert events == [PossibleReply(STREAM)] * 2
    assert answers(protocol.receive(ok("fine"))) == [STREAM]


def test_an_acknowledgement_without_a_name_may_be_a_late_one() -> None:
    protocol = protocol_after(Version())
    protocol.give_up()
    protocol.send(STREAM)
    _, events = protocol.receive(ok("fine"))
    assert events == [PossibleReply(STREAM)]
    assert protocol.assume_reply() == [Answered(STREAM, Packet(1, b"fine"))]


def test_a_refusal_that_names_a_late_command_without_its_parameters_is_not_the_pending_ones() -> None:
    protocol = protocol_after(Version())
    protocol.give_up()
    protocol.send(STREAM)
    _, [event] = protocol.receive(error("Error-version is not known in this form"))
    assert isinstance(event, UnexpectedPacket)
    _, [refused] = protocol.receive(error("Error-streamframes is not known in this form"))
    assert isinstance(refused, Refused)
    assert refused.command == STREAM


def test_no_late_reply_is_assumed_after_the_client_gave_up_again() -> None:
    protocol = protocol_after(Version())
    protocol.give_up()
    protocol.send(STREAM)
    protocol.receive(error("what?"))
    protocol.give_up()
    assert protocol.assume_reply() == []
    protocol.send(SetByteOrder("big"))
    assert protocol.assume_reply() == []


def test_frames_of_a_request_that_seemed_refused_are_streaming() -> None:
    protocol = protocol_after(STREAM)
    protocol.receive(error("what?"))
    frames, _ = protocol.receive(FRAME)
    assert len(frames) == 1
    assert protocol.state is ProtocolState.STREAMING


def test_no_data_after_a_request_that_seemed_refused_is_no_measurement() -> None:
    protocol = protocol_after(STREAM)
    protocol.receive(error("what?"))
    protocol.receive(NO_DATA)
    assert protocol.state is ProtocolState.NO_MEASUREMENT


def test_the_current_frame_of_a_connection_without_a_stream_is_not_streaming() -> None:
    for reply in (FRAME, NO_DATA):
        protocol = protocol_after(SendCurrentFrame())
        protocol.receive(reply)
        assert protocol.state is ProtocolState.IDLE


def test_a_late_reply_that_names_a_command_of_before_an_answer_is_a_duplicate() -> None:
    protocol = protocol_after(STREAM)
    protocol.give_up()
    protocol.send(SetByteOrder("little"))
    protocol.receive(ok("OK-SetByteOrder LittleEndian"))
    protocol.send(StopStreaming())
    _, [event] = protocol.receive(ok(f"OK-{STREAM}"))
    assert isinstance(event, UnexpectedPacket)


@pytest.mark.parametrize(
    ("reply", "after", "with_a_frame"),
    [
        (ok("OK-StreamFrames Stop"), ProtocolState.STOPPED, ProtocolState.STOPPED),
        (error("err-StreamFrames Stop"), ProtocolState.STREAMING, ProtocolState.STREAMING),
        (b"", ProtocolState.IDLE, ProtocolState.STREAMING),
    ],
    ids=["accepted", "refused", "not answered"],
)
def test_a_stop_counts_once_the_server_has_accepted_it(
    reply: bytes, after: ProtocolState, with_a_frame: ProtocolState
) -> None:
    protocol = protocol_after(STREAM)
    protocol.receive(ok(f"OK-{STREAM}") + FRAME)
    protocol.send(StopStreaming())
    states = [protocol.state]
    protocol.receive(reply)
    protocol.give_up()
    states.append(protocol.state)
    protocol.receive(FRAME)
    assert [*states, protocol.state] == [ProtocolState.STREAMING, after, with_a_frame]


def test_a_missing_reply_does_not_shift_the_following_replies() -> None:
    protocol = protocol_after(Version())
    protocol.give_up()
    for command in (SetByteOrder("little"), STREAM, StopStreaming()):
        protocol.send(command)
        assert answers(protocol.receive(ok(f"OK-{command}"))) == [command]


def test_a_reply_that_names_a_later_command_ends_the_wait_for_earlier_replies() -> None:
    protocol = protocol_after(Version())
    protocol.give_up()
    protocol.send(SetByteOrder("little"))
    protocol.receive(ok("OK-SetByteOrder LittleEndian"))
    protocol.send(STREAM)
    assert answers(protocol.receive(ok("OK"))) == [STREAM]


def test_only_xml_answers_send_parameters() -> None:
    protocol = protocol_after(SendParameters(("3d",)))
    assert answers(protocol.receive(ok("OK-SendParameters 3D"))) == []
    assert answers(protocol.receive(xml("The_3D"))) == [SendParameters(("3d",))]


def test_late_xml_does_not_answer_a_request_for_other_sections() -> None:
    protocol = protocol_after(SendParameters(("3d",)))
    protocol.give_up()
    protocol.send(SendParameters(("6d",)))
    assert answers(protocol.receive(xml("The_3D"))) == []
    assert answers(protocol.receive(xml("The_6D"))) == [SendParameters(("6d",))]


def test_xml_with_more_sections_than_requested_is_an_answer() -> None:
    protocol = protocol_after(SendParameters())
    protocol.receive(xml("The_3D", "The_6D"))
    protocol.send(SendParameters(("general",)))
    assert answers(protocol.receive(xml("The_3D", "The_6D"))) == [SendParameters(("general",))]


def test_missing_xml_does_not_shift_the_next_answer() -> None:
    protocol = protocol_after(SendParameters(("3d",)))
    protocol.give_up()
    protocol.send(SendParameters(("6d",)))
    assert answers(protocol.receive(xml("The_6D"))) == [SendParameters(("6d",))]


def test_late_xml_answers_the_same_request_sent_again() -> None:
    protocol = protocol_after(SendParameters())
    protocol.give_up()
    protocol.send(SendParameters())
    assert answers(protocol.receive(xml("The_6D"))) == [SendParameters()]


def test_late_xml_without_a_pending_command_is_no_longer_outstanding() -> None:
    protocol = protocol_after(SendParameters(("3d",)))
    protocol.give_up()
    _, [event] = protocol.receive(xml("The_3D"))
    assert isinstance(event, UnexpectedPacket)
    protocol.send(SendParameters(("6d",)))
    assert answers(protocol.receive(xml("The_3D"))) == [SendParameters(("6d",))]


def test_a_second_reply_to_a_repeated_request_does_not_answer_the_next_request() -> None:
    protocol = protocol_after(SendParameters(("3d",)))
    protocol.give_up()
    protocol.send(SendParameters(("3d",)))
    # This may be the late reply to the first request, or the reply to the second.
    assert answers(protocol.receive(xml("The_3D"))) == [SendParameters(("3d",))]
    protocol.send(SendParameters(("6d",)))
    _, [event] = protocol.receive(xml("The_3D"))
    assert isinstance(event, UnexpectedPacket)
    assert answers(protocol.receive(xml("The_6D"))) == [SendParameters(("6d",))]
