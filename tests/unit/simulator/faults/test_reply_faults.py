"""Faults of the replies to commands."""

import pytest

from gateway.rtc3d.packets import Packet
from gateway.simulator.faults.reply_faults import MinimalServer, RefusedCommands
from tests.unit.rtc3d_server.wire import COMMAND, DATA


@pytest.mark.parametrize(
    ("text", "is_refused"),
    [
        ("Version 1.0", True),
        ("SetByteOrder LittleEndian", True),
        ("SendParameters", True),
        ("SendParameters All", True),
        ("StreamFrames", False),
        ("STREAMFRAMES\0", False),
        ("StreamFrames FrequencyDivisor:4", False),
        ("StreamFrames Stop", False),
        ("StreamFrames AllFrames", True),
        ("StreamFrames Frequency:60", True),
        ("StreamFrames FrequencyDivisor:4 3D", True),
        ("StreamFrames 3D", True),
        ("SendCurrentFrame", False),
        ("SendCurrentFrame 3D", True),
        ("Bye", True),
        ("", True),
    ],
)
def test_a_minimal_server_accepts_only_the_commands_of_field_note_2(text: str, is_refused: bool) -> None:
    assert (MinimalServer().refusal(Packet(COMMAND, text.encode())) is not None) == is_refused


def test_refused_commands_are_recognised_by_their_first_word() -> None:
    fault = RefusedCommands(commands=("setbyteorder", "bye"))
    refused = {
        text: fault.refusal(Packet(COMMAND, text.encode()))
        for text in ("SetByteOrder BigEndian", "bye\0", "Version 1.0", "StreamFrames", "")
    }
    assert refused == {
        "SetByteOrder BigEndian": "setbyteorder is refused",
        "bye\0": "bye is refused",
        "Version 1.0": None,
        "StreamFrames": None,
        "": None,
    }


def test_packets_that_are_not_commands_are_not_refused() -> None:
    for fault in (MinimalServer(), RefusedCommands(commands=("version",))):
        assert fault.refusal(Packet(DATA, b"Version 1.0")) is None
