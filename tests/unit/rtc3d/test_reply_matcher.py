"""Replies to commands, in every order that the field notes describe and in some others."""

from collections.abc import Sequence
from typing import Final

import pytest

from gateway.rtc3d.client_protocol import Answered, ClientProtocol, PossibleReply, ProtocolEvent, Refused
from gateway.rtc3d.commands import (
    Command,
    SendCurrentFrame,
    SendParameters,
    SetByteOrder,
    StopStreaming,
    StreamFrames,
    Version,
)
from tests.servers import error, ok
from tests.unit.rtc3d.protocols import FRAME, STREAM, xml

GIVE_UP: Final = "give up"
ASSUME: Final = "assume"
LITTLE: Final = SetByteOrder("little")
OK_LITTLE: Final = ok("OK-SetByteOrder LittleEndian")
STOP: Final = StopStreaming()
ALL: Final = SendParameters()
ONLY_3D: Final = SendParameters(("3d",))
ONLY_6D: Final = SendParameters(("6d",))

Step = Command | bytes | str
"""A command to send, bytes to receive, or what else the client does."""


def outcome(event: ProtocolEvent) -> str:
    match event:
        case Answered(command):
            return f"{command}: answered"
        case Refused(command):
            return f"{command}: refused"
        case PossibleReply(command):
            return f"{command}: maybe"
    return "unexpected"


def outcomes_of(steps: Sequence[Step]) -> list[str]:
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
    return [outcome(event) for event in events]


@pytest.mark.parametrize("text", ["OK-Version 1.0", "version 1.0", "ok-version", "OK", "", "Version 1.0\0\0"])
def test_the_type_of_a_reply_decides_and_not_its_text(text: str) -> None:
    """Every server words its replies differently (field note 1)."""
    assert outcomes_of([Version(), ok(text)]) == ["Version 1.0: answered"]
    assert outcomes_of([Version(), error(text)]) == ["Version 1.0: refused"]


# Each row: what happens, and what the client makes of what it receives.
DUPLICATES: Final = {
    "nothing was asked": ([ok("hello")], ["unexpected"]),
    "that name no command": ([Version(), ok("OK") * 2], ["Version 1.0: answered", "unexpected"]),
    **{
        f"{text} after the next command": (
            [Version(), ok(text), LITTLE, ok(text), error("err-no")],
            ["Version 1.0: answered", "unexpected", f"{LITTLE}: refused"],
        )
        for text in ("OK-Version 1.0", "version 1.0", "ok-version")
    },
    "of StreamFrames before that of Stop": (
        [STREAM, ok(f"OK-{STREAM}"), STOP, ok(f"OK-{STREAM}"), ok("OK-StreamFrames Stop")],
        [f"{STREAM}: answered", "unexpected", f"{STOP}: answered"],
    ),
    "that name a command given up before another was answered": (
        [STREAM, GIVE_UP, LITTLE, OK_LITTLE, STOP, ok(f"OK-{STREAM}")],
        [f"{LITTLE}: answered", "unexpected"],
    ),
    "of a repeated request for parameters": (
        [ONLY_3D, GIVE_UP, ONLY_3D, xml("The_3D"), ONLY_6D, xml("The_3D"), xml("The_6D")],
        [f"{ONLY_3D}: answered", "unexpected", f"{ONLY_6D}: answered"],
    ),
}

LATE: Final = {
    "that name the later command by its verb": (
        [Version(), GIVE_UP, LITTLE, ok("ok-setbyteorder")],
        [f"{LITTLE}: answered"],
    ),
    "that name the earlier command": (
        [Version(), GIVE_UP, LITTLE, ok("OK-Version 1.0"), OK_LITTLE],
        ["unexpected", f"{LITTLE}: answered"],
    ),
    "that name none": (
        [Version(), GIVE_UP, LITTLE, ok("OK"), ok("OK")],
        [f"{LITTLE}: maybe", f"{LITTLE}: answered"],
    ),
    "that name the later command first": (
        [Version(), GIVE_UP, LITTLE, OK_LITTLE, STREAM, ok("OK")],
        [f"{LITTLE}: answered", f"{STREAM}: answered"],
    ),
    "that are refusals, while XML answers": (
        [Version(), GIVE_UP, ALL, error("err-unknown command"), xml("The_3D"), ASSUME],
        [f"{ALL}: maybe", f"{ALL}: answered"],
    ),
    "that may be those to the pending command": (
        [Version(), GIVE_UP, STREAM, error("what?"), ASSUME, ASSUME],
        [f"{STREAM}: maybe", f"{STREAM}: refused"],
    ),
    "that may accept the pending command": (
        [Version(), GIVE_UP, STREAM, ok("fine"), ASSUME],
        [f"{STREAM}: maybe", f"{STREAM}: answered"],
    ),
    "from a server that ignored the first command": (
        [Version(), GIVE_UP, STREAM, error("what?"), ASSUME, StreamFrames(), error("what?")],
        [f"{STREAM}: maybe", f"{STREAM}: refused", "StreamFrames: refused"],
    ),
    "that name a command without its parameters": (
        [
            *(Version(), GIVE_UP, STREAM),
            *(error("Error-version is not known in this form"), error("Error-streamframes is not known")),
        ],
        ["unexpected", f"{STREAM}: refused"],
    ),
    "before the client gave up again": (
        [Version(), GIVE_UP, STREAM, error("what?"), GIVE_UP, ASSUME, LITTLE, ASSUME],
        [f"{STREAM}: maybe"],
    ),
    "that name another command than the only pending one": (
        [LITTLE, error("Version must be sent first")],
        [f"{LITTLE}: refused"],
    ),
    "that follow the frames of a request, which were its answer": (
        [STREAM, FRAME, STOP, ok("OK"), ok("OK")],
        [f"{STREAM}: answered", f"{STOP}: maybe", f"{STOP}: answered"],
    ),
    "to a ninth command, of which eight are remembered": (
        [*(step for _ in range(9) for step in (Version(), GIVE_UP)), LITTLE, *[ok("OK")] * 9],
        [*[f"{LITTLE}: maybe"] * 8, f"{LITTLE}: answered"],
    ),
}

PARAMETERS: Final = {
    "only XML answers": (
        [ONLY_3D, ok("OK-SendParameters 3D"), xml("The_3D")],
        ["unexpected", f"{ONLY_3D}: answered"],
    ),
    "of other sections are late": (
        [ONLY_3D, GIVE_UP, ONLY_6D, xml("The_3D"), xml("The_6D")],
        ["unexpected", f"{ONLY_6D}: answered"],
    ),
    "without a section that the server lacks": (
        [ONLY_6D, GIVE_UP, SendParameters(("general", "3d")), xml("The_3D")],
        ["SendParameters General 3D: answered"],
    ),
    "late, to the same request sent again": ([ALL, GIVE_UP, ALL, xml("The_6D")], [f"{ALL}: answered"]),
    "late, while nothing is pending": (
        [ONLY_3D, GIVE_UP, xml("The_3D"), ONLY_6D, xml("The_3D")],
        ["unexpected", f"{ONLY_6D}: answered"],
    ),
}

CURRENT: Final = SendCurrentFrame()
FRAMES: Final = {
    "after an acknowledgement": (
        [CURRENT, ok("OK-SendCurrentFrame"), FRAME],
        ["unexpected", f"{CURRENT}: answered"],
    ),
    "that stream at the former rate": (
        [STREAM, FRAME, ok(f"OK-{STREAM}"), StreamFrames(), FRAME, error("err-no")],
        [f"{STREAM}: answered", "unexpected", "StreamFrames: refused"],
    ),
    "in two reads": (
        [STREAM, FRAME + ok("OK-StreamFrames"), CURRENT, FRAME[:20], FRAME[20:]],
        [f"{STREAM}: answered", "unexpected", f"{CURRENT}: answered"],
    ),
}


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        pytest.param(*row, id=f"{topic}: {name}")
        for topic, rows in (
            ("duplicates", DUPLICATES),
            ("late replies", LATE),
            ("parameters", PARAMETERS),
            ("frames", FRAMES),
        )
        for name, row in rows.items()
    ],
)
def test_each_reply_goes_to_the_command_that_it_answers(steps: list[Step], expected: list[str]) -> None:
    """A reply taken for that of another command would start, stop or configure the wrong thing."""
    assert outcomes_of(steps) == expected
