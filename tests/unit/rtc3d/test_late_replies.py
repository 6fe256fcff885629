"""Late replies to a command that was repeated after its time-out, as the session repeats commands."""

from gateway.rtc3d.client_protocol import Answered, ClientProtocol, ProtocolEvent, UnexpectedPacket
from gateway.rtc3d.commands import SendParameters
from gateway.rtc3d.frames import Frame
from tests.servers import packet

MARKERS_XML = packet(2, "<RT_Parameters Ver='1.00'><The_3D/></RT_Parameters>")
TOOLS_XML = packet(2, "<RT_Parameters Ver='1.00'><The_6D/></RT_Parameters>")
MARKERS, TOOLS = SendParameters(("3d",)), SendParameters(("6d",))


def only_event(received: tuple[list[Frame], list[ProtocolEvent]]) -> ProtocolEvent:
    frames, [event] = received
    assert not frames
    return event


def test_the_second_reply_to_a_repeated_question_does_not_answer_the_next_question() -> None:
    protocol = ClientProtocol()
    protocol.send(MARKERS)
    protocol.give_up()
    protocol.send(MARKERS)
    event = only_event(protocol.receive(MARKERS_XML))  # the late reply, or the second one: nobody can know
    assert isinstance(event, Answered)
    protocol.send(TOOLS)
    assert isinstance(only_event(protocol.receive(MARKERS_XML)), UnexpectedPacket)
    event = only_event(protocol.receive(TOOLS_XML))
    assert isinstance(event, Answered)
    assert event.command == TOOLS
