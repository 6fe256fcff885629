"""Commands (§5): their texts, other spellings that clients use, and the errors of everything else."""

import pytest

from gateway.errors import CommandError
from gateway.rtc3d.commands import (
    AllFrames,
    Bye,
    Command,
    ControlRecording,
    Frequency,
    FrequencyDivisor,
    SendCurrentFrame,
    SendParameters,
    SetByteOrder,
    StopStreaming,
    StreamFrames,
    Version,
    encode_command,
    parse_command,
)
from gateway.rtc3d.components import ComponentType

MARKERS, ANALOG, FORCE = ComponentType.MARKERS, ComponentType.ANALOG, ComponentType.FORCE
TOOLS, EVENT = ComponentType.TOOLS, ComponentType.EVENT

# Each command with its canonical text. "§" marks examples of the specification.
TEXTS: list[tuple[Command, str]] = [
    (Version(), "Version 1.0"),  # § 5.3.1
    (SetByteOrder("little"), "SetByteOrder LittleEndian"),  # § 5.3.2
    (SetByteOrder("big"), "SetByteOrder BigEndian"),
    (SendParameters(("3d", "force")), "SendParameters 3D Force"),  # § 5.3.3
    (SendParameters(), "SendParameters"),
    (SendParameters(("general", "analog", "6d", "events")), "SendParameters General Analog 6D Events"),  # § 6
    (ControlRecording(start=True), "Recording Start"),  # field note 18
    (ControlRecording(start=False), "Recording Stop"),
    (SendCurrentFrame((MARKERS, ANALOG)), "SendCurrentFrame 3D Analog"),  # § 5.3.4
    (SendCurrentFrame(), "SendCurrentFrame"),
    (SendCurrentFrame((FORCE, TOOLS, EVENT)), "SendCurrentFrame Force 6D Events"),  # field note 14
    (StreamFrames(Frequency(30), (MARKERS, ANALOG)), "StreamFrames Frequency:30 3D Analog"),  # § 5.3.5
    (StreamFrames(FrequencyDivisor(4)), "StreamFrames FrequencyDivisor:4"),
    (StreamFrames(Frequency(59.94)), "StreamFrames Frequency:59.94"),
    (StreamFrames(Frequency(0.000001)), "StreamFrames Frequency:0.000001"),
    (StreamFrames(Frequency(123456789.123456)), "StreamFrames Frequency:123456789.123456"),
    (StreamFrames(AllFrames(), (FORCE,)), "StreamFrames AllFrames Force"),
    (StreamFrames(), "StreamFrames"),
    (StopStreaming(), "StreamFrames Stop"),  # § 5.3.5
    (Bye(), "Bye"),  # § 5.3.6
]

# What follows a word in the errors that list the known ones.
COMMANDS = "known are Version, SetByteOrder, SendParameters, SendCurrentFrame, StreamFrames, Bye"
SECTIONS = "known are All, General, 3D, 6D, Analog, Force, Events, Event"
COMPONENTS = "known are All, 3D, 6D, Analog, Force, Events, Event"
STREAM = f"{COMPONENTS}, FrequencyDivisor:n, Frequency:n, AllFrames, Stop (alone)"
RATES = "known are FrequencyDivisor:n (n a whole number from 1), Frequency:n (n Hz, above 0), AllFrames"
ONE_RATE = "StreamFrames takes one of FrequencyDivisor:n, Frequency:n, AllFrames"


def error_text(body: bytes) -> str:
    with pytest.raises(CommandError) as caught:
        parse_command(body)
    return str(caught.value)


def test_each_command_is_encoded_as_its_text_and_parsed_from_it() -> None:
    """Clients differ in spaces (§5.2); the property tests prove it for case and endings."""
    for command, text in TEXTS:
        body = text.encode("ascii")
        assert (str(command), encode_command(command)) == (text, body)
        assert parse_command(body) == parse_command(body.replace(b" ", b"   ")) == command, text


@pytest.mark.parametrize(
    ("text", "command"),
    [
        ("SendParameters 3D All", SendParameters()),
        ("SendParameters Event", SendParameters(("events",))),
        ("SendParameters 3D Force 3d", SendParameters(("3d", "force"))),
        ("SendCurrentFrame All 6D", SendCurrentFrame()),
        ("SendCurrentFrame Event", SendCurrentFrame((EVENT,))),
        ("StreamFrames All", StreamFrames()),
        ("StreamFrames Frequency:60 All 3D", StreamFrames(Frequency(60))),
        ("StreamFrames 3D 3D Event Events", StreamFrames(None, (MARKERS, EVENT))),
        ("StreamFrames 3D Frequency:60 6D", StreamFrames(Frequency(60), (MARKERS, TOOLS))),
        ("StreamFrames Frequency:060.50", StreamFrames(Frequency(60.5))),
        ("StreamFrames FrequencyDivisor:004", StreamFrames(FrequencyDivisor(4))),
        ("StreamFrames" + " 3D 6D" * 200_000, StreamFrames(None, (MARKERS, TOOLS))),
        ("Version 01.00", Version("01.00")),
        ("recording stop,now", ControlRecording(start=False)),
        (
            "RECORDING START,file=C:\\My  takes\\A b.c3d\n",
            ControlRecording(start=True, options=",file=C:\\My  takes\\A b.c3d"),
        ),
    ],
    ids=lambda value: str(value)[:60],
)
def test_other_spellings_are_parsed(text: str, command: Command) -> None:
    """They are in use; a file name keeps its case and its spaces."""
    assert parse_command(text.encode("ascii")) == command


@pytest.mark.parametrize(
    ("verb", "parameters", "text"),
    [
        ("", ["", "\0", "\n", " \r\n\0\0"], f"Empty command; {COMMANDS}"),
        (
            "Version",
            ["", "1", "1.", ".0", "1.0.0", "1,0", "one", "1.0 1.0", "-1.0", "1.0e0", "12345.0", "1.12345"],
            "Version takes one parameter n.n, as in: Version 1.0",
        ),
        (
            "SetByteOrder",
            ["", "Big", "MiddleEndian", "BigEndian LittleEndian", "1"],
            "SetByteOrder takes one parameter, BigEndian or LittleEndian",
        ),
        ("SendParameters", ["5D", "3D 5D", "All 5D", "5D All"], f"Unknown section '5d'; {SECTIONS}"),
        ("SendParameters", ["3D,5D"], f"Unknown section '3d,5d'; {SECTIONS}"),
        ("SendCurrentFrame", ["5D", "3D 5D", "All 5D"], f"Unknown component '5d'; {COMPONENTS}"),
        ("SendCurrentFrame", ["General"], f"Unknown component 'general'; {COMPONENTS}"),
        ("StreamFrames", ["5D", "Frequency:60 5D", "All 5D"], f"Unknown parameter '5d'; {STREAM}"),
        ("StreamFrames", ["Stop 3D", "3D Stop", "Stop Stop"], f"Unknown parameter 'stop'; {STREAM}"),
        ("StreamFrames", ["AllFrames Frequency:60", "Frequency:60 3D Frequency:60"], ONE_RATE),
        ("Bye", ["now"], "Bye takes no parameter"),
        (
            "Recording",
            ["", "Pause", "Startled", "Stopwatch"],
            "Recording takes Start or Stop, as in: Recording Start,file=take.c3d",
        ),
    ],
)
def test_the_error_says_what_is_accepted(verb: str, parameters: list[str], text: str) -> None:
    """The server sends the text to the client, whose author has no other description."""
    for each in parameters:
        assert error_text(f"{verb} {each}".encode()) == text, each


def test_the_error_of_an_invalid_rate_shows_the_three_forms() -> None:
    """A rate that is misread would make the server send too much or nothing."""
    numbers = ["", *["0", "-60", "+60", "60Hz", "nan", "inf", "1e3", "1_000", "60:30", "٦"]]
    rates = [prefix + number for prefix in ("Frequency:", "FrequencyDivisor:") for number in numbers]
    for rate in (*rates, "Frequency:0.0000009", "Frequency:" + "9" * 400, "FrequencyDivisor:2.5", ":"):
        text = error_text(f"StreamFrames 3D {rate}".encode())
        assert text.startswith(f"Unknown rate '{rate[:10].lower()}"), rate
        assert text.endswith(f"; {RATES}")


@pytest.mark.parametrize(
    ("word", "shown"),
    [("x" * 40, "x" * 40), ("x" * 41, "x" * 40 + "?"), ("\xe9", "?"), ("\x01", r"\x01"), ("3D", "3D")],
)
def test_an_unknown_command_is_quoted_with_up_to_40_printable_characters(word: str, shown: str) -> None:
    """Clients are untrusted, and their words go into logs and packets."""
    assert error_text(word.encode("latin-1")) == f"Unknown command '{shown}'; {COMMANDS}"


@pytest.mark.parametrize("before", ["", "Version ", "SetByteOrder ", "SendParameters ", "SendCurrentFrame "])
def test_the_error_text_of_a_huge_or_binary_word_is_short_and_printable(before: str) -> None:
    """It must fit into an error packet."""
    for word in (b"A" * 1_000_000, b"\xff" * 100_000, b"\x01" * 1000, b"'\"\\" * 1000, b"a\0" * 1000):
        for body in (before.encode() + word, before.encode() + word + b" " + word):
            text = error_text(body)
            assert (text.isascii(), text.isprintable(), len(text) < 300) == (True, True, True)
