"""Replies to commands, in every order that the field notes describe and in some others."""

import pytest

from gateway.rtc3d.client_protocol import (
    Answered,
    ClientProtocol,
    Refused,
    UnexpectedPacket,
)
from gateway.rtc3d.commands import (
    SendParameters,
    SetByteOrder,
    StopStreaming,
    Version,
)
from tests.servers import error, ok
from tests.unit.rtc3d.protocols import STREAM, answers, protocol_after, xml


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


def test_a_late_refusal_does_not_answer_the_next_command() -> None:
    protocol = protocol_after(Version())
    protocol.give_up()
    protocol.send(SendParameters())
    _, [event] = protocol.receive(error("err-unknown command"))
    assert isinstance(event, UnexpectedPacket)
    assert answers(protocol.receive(xml("The_3D"))) == [SendParameters()]


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
