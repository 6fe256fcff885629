"""Replies to commands, in every order that the field notes describe and in some others."""

from collections.abc import Sequence
from typing import Final

import pytest

from gateway.rtc3d.client_protocol import Answered, ClientProtocol, PossibleReply, ProtocolEvent, Refused
from gateway.rtc3d.commands import (
    AllFrames,
    Command,
    SendCurrentFrame,
    SendParameters,
    SetByteOrder,
    StopStreaming,
    StreamFrames,
    Version,
)
from gateway.rtc3d.components import ComponentType
from tests.support.servers import error, ok, packet
from tests.support.vectors import FULL_FRAME

VERSION: Final = Version()
STREAM: Final = StreamFrames(AllFrames(), (ComponentType.MARKERS,))
FRAME: Final = packet(3, FULL_FRAME["big"])
CURRENT: Final = SendCurrentFrame()
GIVE_UP: Final = "give up"
ASSUME: Final = "assume"
LITTLE: Final = SetByteOrder("little")
OK_LITTLE: Final = ok("OK-SetByteOrder LittleEndian")
STOP: Final = StopStreaming()
ALL: Final = SendParameters()
ONLY_3D: Final = SendParameters(("3d",))
ONLY_6D: Final = SendParameters(("6d",))
GENERAL_3D: Final = SendParameters(("general", "3d"))

Step = Command | bytes | str
"""A command to send, bytes to receive, or what else the client does."""

_COMMANDS = (VERSION, LITTLE, STREAM, STOP, CURRENT, ALL, ONLY_3D, ONLY_6D, StreamFrames(), GENERAL_3D)
_NAMES = ("version", "little", "stream", "stop", "current", "all", "3d", "6d", "streamframes", "general 3d")
NAMES: Final = dict(zip(_COMMANDS, _NAMES, strict=True))


def xml(section: str) -> bytes:
    """Return an XML packet with an empty element of §6."""
    return packet(2, f"<RT_Parameters Ver='1.00'><{section}/></RT_Parameters>")


def outcome(event: ProtocolEvent) -> str:
    match event:
        case Answered(command):
            return f"{NAMES[command]} answered"
        case Refused(command):
            return f"{NAMES[command]} refused"
        case PossibleReply(command):
            return f"{NAMES[command]} maybe"
    return "unexpected"


def outcomes_of(steps: Sequence[Step]) -> str:
    """Return what the client makes of everything that it receives."""
    protocol, events = ClientProtocol(), []
    for step in steps:
        if isinstance(step, bytes):
            events += protocol.receive(step)[1]
        elif step == ASSUME:
            events += protocol.assume_reply()
        elif step == GIVE_UP:
            protocol.give_up()
        elif not isinstance(step, str):
            protocol.send(step)
    return ", ".join(map(outcome, events))


@pytest.mark.parametrize("text", ["OK-Version 1.0", "version 1.0", "ok-version", "OK", "", "Version 1.0\0\0"])
def test_the_type_of_a_reply_decides_and_not_its_text(text: str) -> None:
    """Every server words its replies differently (field note 1)."""
    assert outcomes_of([VERSION, ok(text)]) == "version answered"
    assert outcomes_of([VERSION, error(text)]) == "version refused"


# Each row: what happens, and what the client makes of what it receives.
ROWS: Final[list[tuple[Sequence[object], str]]] = [
    # Duplicates: nothing was asked.
    ([ok("hello")], "unexpected"),
    # Duplicates: that name no command.
    ([VERSION, ok("OK") * 2], "version answered, unexpected"),
    # Duplicates: after the next command.
    *(
        (
            [VERSION, ok(text), LITTLE, ok(text), error("err-no")],
            "version answered, unexpected, little refused",
        )
        for text in ("OK-Version 1.0", "version 1.0", "ok-version")
    ),
    # Duplicates: of StreamFrames before that of Stop.
    (
        [STREAM, ok(f"OK-{STREAM}"), STOP, ok(f"OK-{STREAM}"), ok("OK-StreamFrames Stop")],
        "stream answered, unexpected, stop answered",
    ),
    # Duplicates: that name a command given up before another was answered.
    ([STREAM, GIVE_UP, LITTLE, OK_LITTLE, STOP, ok(f"OK-{STREAM}")], "little answered, unexpected"),
    # Duplicates: of a repeated request for parameters.
    (
        [ONLY_3D, GIVE_UP, ONLY_3D, xml("The_3D"), ONLY_6D, xml("The_3D"), xml("The_6D")],
        "3d answered, unexpected, 6d answered",
    ),
    # Late replies: that name the later command by its verb.
    ([VERSION, GIVE_UP, LITTLE, ok("ok-setbyteorder")], "little answered"),
    # Late replies: that name the earlier command.
    ([VERSION, GIVE_UP, LITTLE, ok("OK-Version 1.0"), OK_LITTLE], "unexpected, little answered"),
    # Late replies: that name none.
    ([VERSION, GIVE_UP, LITTLE, ok("OK"), ok("OK")], "little maybe, little answered"),
    # Late replies: that name the later command first.
    ([VERSION, GIVE_UP, LITTLE, OK_LITTLE, STREAM, ok("OK")], "little answered, stream answered"),
    # Late replies: that are refusals, while XML answers.
    ([VERSION, GIVE_UP, ALL, error("err-unknown command"), xml("The_3D"), ASSUME], "all maybe, all answered"),
    # Late replies: that may be those to the pending command.
    ([VERSION, GIVE_UP, STREAM, error("what?"), ASSUME, ASSUME], "stream maybe, stream refused"),
    # Late replies: that may accept the pending command.
    ([VERSION, GIVE_UP, STREAM, ok("fine"), ASSUME], "stream maybe, stream answered"),
    # Late replies: from a server that ignored the first command.
    (
        [VERSION, GIVE_UP, STREAM, error("what?"), ASSUME, StreamFrames(), error("what?")],
        "stream maybe, stream refused, streamframes refused",
    ),
    # Late replies: that name a command without its parameters.
    (
        [
            *(VERSION, GIVE_UP, STREAM),
            *(error("Error-version is not known in this form"), error("Error-streamframes is not known")),
        ],
        "unexpected, stream refused",
    ),
    # Late replies: before the client gave up again.
    ([VERSION, GIVE_UP, STREAM, error("what?"), GIVE_UP, ASSUME, LITTLE, ASSUME], "stream maybe"),
    # Late replies: that name another command than the only pending one.
    ([LITTLE, error("Version must be sent first")], "little refused"),
    # Late replies: that follow the frames of a request, which were its answer.
    ([STREAM, FRAME, STOP, ok("OK"), ok("OK")], "stream answered, stop maybe, stop answered"),
    # Late replies: to a ninth command, of which eight are remembered.
    (
        [*(step for _ in range(9) for step in (VERSION, GIVE_UP)), LITTLE, *[ok("OK")] * 9],
        "little maybe, " * 8 + "little answered",
    ),
    # Parameters: only XML answers.
    ([ONLY_3D, ok("OK-SendParameters 3D"), xml("The_3D")], "unexpected, 3d answered"),
    # Parameters: of other sections are late.
    ([ONLY_3D, GIVE_UP, ONLY_6D, xml("The_3D"), xml("The_6D")], "unexpected, 6d answered"),
    # Parameters: without a section that the server lacks.
    ([ONLY_6D, GIVE_UP, GENERAL_3D, xml("The_3D")], "general 3d answered"),
    # Parameters: late, to the same request sent again.
    ([ALL, GIVE_UP, ALL, xml("The_6D")], "all answered"),
    # Parameters: late, while nothing is pending.
    ([ONLY_3D, GIVE_UP, xml("The_3D"), ONLY_6D, xml("The_3D")], "unexpected, 6d answered"),
    # Frames: after an acknowledgement.
    ([CURRENT, ok("OK-SendCurrentFrame"), FRAME], "unexpected, current answered"),
    # Frames: that stream at the former rate.
    (
        [STREAM, FRAME, ok(f"OK-{STREAM}"), StreamFrames(), FRAME, error("err-no")],
        "stream answered, unexpected, streamframes refused",
    ),
    # Frames: in two reads.
    (
        [STREAM, FRAME + ok("OK-StreamFrames"), CURRENT, FRAME[:20], FRAME[20:]],
        "stream answered, unexpected, current answered",
    ),
]


@pytest.mark.parametrize(("steps", "expected"), ROWS)
def test_each_reply_goes_to_the_command_that_it_answers(steps: list[Step], expected: str) -> None:
    """A reply taken for that of another command would start, stop or configure the wrong thing."""
    assert outcomes_of(steps) == expected
