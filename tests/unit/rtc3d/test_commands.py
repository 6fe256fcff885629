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
    (Version("2.13"), "Version 2.13"),
    (SetByteOrder("little"), "SetByteOrder LittleEndian"),  # § 5.3.2
    (SetByteOrder("big"), "SetByteOrder BigEndian"),
    (SendParameters(("3d", "force")), "SendParameters 3D Force"),  # § 5.3.3
    (SendParameters(), "SendParameters"),
    (SendParameters(("general",)), "SendParameters General"),  # § 6.1
    (SendParameters(("3d",)), "SendParameters 3D"),  # § 6.2
    (SendParameters(("6d",)), "SendParameters 6D"),
    (SendParameters(("analog",)), "SendParameters Analog"),  # § 6.4
    (SendParameters(("force",)), "SendParameters Force"),  # § 6.5
    (SendParameters(("events",)), "SendParameters Events"),  # § 6.6
    (
        SendParameters(("general", "3d", "analog", "force", "6d", "events")),
        "SendParameters General 3D Analog Force 6D Events",
    ),
    (ControlRecording(start=True), "Recording Start"),  # field note 18
    (ControlRecording(start=False), "Recording Stop"),
    (SendCurrentFrame((MARKERS, ANALOG)), "SendCurrentFrame 3D Analog"),  # § 5.3.4
    (SendCurrentFrame(), "SendCurrentFrame"),
    (SendCurrentFrame((TOOLS,)), "SendCurrentFrame 6D"),
    (SendCurrentFrame((FORCE, EVENT)), "SendCurrentFrame Force Events"),  # field note 14
    (StreamFrames(Frequency(30), (MARKERS, ANALOG)), "StreamFrames Frequency:30 3D Analog"),  # § 5.3.5
    (StreamFrames(FrequencyDivisor(4)), "StreamFrames FrequencyDivisor:4"),
    (StreamFrames(Frequency(60)), "StreamFrames Frequency:60"),
    (StreamFrames(Frequency(59.94)), "StreamFrames Frequency:59.94"),
    (StreamFrames(Frequency(0.5)), "StreamFrames Frequency:0.5"),
    (StreamFrames(Frequency(100)), "StreamFrames Frequency:100"),
    (StreamFrames(Frequency(0.000001)), "StreamFrames Frequency:0.000001"),
    (StreamFrames(Frequency(123456789.123456)), "StreamFrames Frequency:123456789.123456"),
    (StreamFrames(AllFrames()), "StreamFrames AllFrames"),
    (StreamFrames(AllFrames(), (FORCE,)), "StreamFrames AllFrames Force"),
    (StreamFrames(), "StreamFrames"),
    (StreamFrames(None, (TOOLS, EVENT)), "StreamFrames 6D Events"),
    (
        StreamFrames(FrequencyDivisor(1), (MARKERS, ANALOG, FORCE, TOOLS, EVENT)),
        "StreamFrames FrequencyDivisor:1 3D Analog Force 6D Events",
    ),
    (StopStreaming(), "StreamFrames Stop"),  # § 5.3.5
    (Bye(), "Bye"),  # § 5.3.6
]

each_text = pytest.mark.parametrize(("command", "text"), TEXTS, ids=[text for _, text in TEXTS])


def error_text(body: bytes) -> str:
    """Return the text of the error that the body raises, which must fit into an error packet."""
    with pytest.raises(CommandError) as caught:
        parse_command(body)
    text = str(caught.value)
    assert text.isascii()
    assert text.isprintable()
    assert len(text) < 300
    return text


@each_text
def test_each_command_is_encoded_as_its_text(command: Command, text: str) -> None:
    assert str(command) == text
    assert encode_command(command) == text.encode("ascii")


@each_text
def test_each_command_is_parsed_from_its_text(command: Command, text: str) -> None:
    assert parse_command(text.encode("ascii")) == command


@pytest.mark.parametrize("end", [b"\0", b"\n", b"\r\n", b" ", b"   ", b" \0", b"\n\0", b"\0\n", b" \r\n\0\0"])
@each_text
def test_each_command_is_parsed_with_any_ending(command: Command, text: str, end: bytes) -> None:
    assert parse_command(text.encode("ascii") + end) == command


@each_text
def test_each_command_is_parsed_in_any_case(command: Command, text: str) -> None:
    body = text.encode("ascii")
    for variant in (body.lower(), body.upper(), body.swapcase()):
        assert parse_command(variant) == command


@each_text
def test_each_command_is_parsed_with_several_spaces(command: Command, text: str) -> None:
    assert parse_command(text.replace(" ", "   ").encode("ascii")) == command


@pytest.mark.parametrize(
    ("text", "command"),
    [
        ("SendParameters All", SendParameters()),
        ("SendParameters 3D All", SendParameters()),
        ("SendParameters Event", SendParameters(("events",))),
        ("SendParameters 3D Force 3d", SendParameters(("3d", "force"))),
        ("SendCurrentFrame All", SendCurrentFrame()),
        ("SendCurrentFrame All 6D", SendCurrentFrame()),
        ("SendCurrentFrame Event", SendCurrentFrame((EVENT,))),
        ("StreamFrames All", StreamFrames()),
        ("StreamFrames AllFrames All", StreamFrames(AllFrames())),
        ("StreamFrames Frequency:60 All 3D", StreamFrames(Frequency(60))),
        ("StreamFrames 3D 3D Event Events", StreamFrames(None, (MARKERS, EVENT))),
        ("StreamFrames 3D Frequency:60 6D", StreamFrames(Frequency(60), (MARKERS, TOOLS))),
        ("StreamFrames Frequency:060.50", StreamFrames(Frequency(60.5))),
        ("StreamFrames FrequencyDivisor:004", StreamFrames(FrequencyDivisor(4))),
        ("Version 01.00", Version("01.00")),
    ],
)
def test_other_spellings_are_parsed(text: str, command: Command) -> None:
    assert parse_command(text.encode("ascii")) == command


# Errors ---------------------------------------------------------------------------------------

ALL_COMMANDS = ("Version", "SetByteOrder", "SendParameters", "SendCurrentFrame", "StreamFrames", "Bye")
ALL_COMPONENTS = ("All", "3D", "6D", "Analog", "Force", "Events")
ALL_SECTIONS = ("All", "General", "3D", "6D", "Analog", "Force", "Events")
ALL_RATES = ("FrequencyDivisor:n", "Frequency:n", "AllFrames")


@pytest.mark.parametrize("body", [b"Hello", b"Hello 3D", b"StreamFrames3D", b"GetState", b"3D", b"Stop"])
def test_the_error_of_an_unknown_command_lists_the_known_ones(body: bytes) -> None:
    text = error_text(body)
    assert body.split()[0].decode() in text
    for word in ALL_COMMANDS:
        assert word in text


@pytest.mark.parametrize("body", [b"", b"\0", b"\n", b"   ", b" \r\n\0\0"])
def test_the_error_of_an_empty_command_lists_the_known_ones(body: bytes) -> None:
    text = error_text(body)
    assert "empty" in text.lower()
    for word in ALL_COMMANDS:
        assert word in text


@pytest.mark.parametrize(
    "parameters",
    ["", "1", "1.", ".0", "1.0.0", "1,0", "one", "1.0 1.0", "-1.0", "+1.0", "1.0e0", "12345.0", "1.12345"],
)
def test_the_error_of_a_version_that_is_not_n_n_shows_the_form(parameters: str) -> None:
    text = error_text(f"Version {parameters}".encode())
    assert "n.n" in text
    assert "Version 1.0" in text


@pytest.mark.parametrize("parameters", ["", "Big", "Little", "MiddleEndian", "BigEndian LittleEndian", "1"])
def test_the_error_of_an_unknown_byte_order_lists_the_known_ones(parameters: str) -> None:
    text = error_text(f"SetByteOrder {parameters}".encode())
    assert "BigEndian" in text
    assert "LittleEndian" in text


@pytest.mark.parametrize("parameters", ["5D", "3D 5D", "All 5D", "5D All", "3D,5D"])
def test_the_error_of_an_unknown_section_names_it_and_lists_the_known_ones(parameters: str) -> None:
    text = error_text(f"SendParameters {parameters}".encode())
    assert "5d" in text.lower()
    for word in ALL_SECTIONS:
        assert word in text


@pytest.mark.parametrize("parameters", ["5D", "3D 5D", "All 5D", "3D,5D", "General 5D", "Frequency:60 5D"])
def test_the_error_of_an_unknown_component_lists_the_known_ones(parameters: str) -> None:
    text = error_text(f"SendCurrentFrame {parameters}".encode())
    for word in ALL_COMPONENTS:
        assert word in text


@pytest.mark.parametrize("parameters", ["5D", "Frequency:60 5D", "All 5D", "3D General", "60", "Frequency"])
def test_the_error_of_an_unknown_parameter_of_stream_frames_lists_all_parameters(parameters: str) -> None:
    text = error_text(f"StreamFrames {parameters}".encode())
    assert parameters.rsplit(" ", 1)[-1].lower() in text.lower()
    for word in (*ALL_COMPONENTS, *ALL_RATES, "Stop"):
        assert word in text


@pytest.mark.parametrize(
    "rate",
    [
        "Frequency:",
        "Frequency:0",
        "Frequency:0.000000",
        "Frequency:-60",
        "Frequency:+60",
        "Frequency:60Hz",
        "Frequency:nan",
        "Frequency:inf",
        "Frequency:1e3",
        "Frequency:1_000",
        "Frequency:60:30",
        "Frequency:" + "9" * 400,
        "Frequency:\N{ARABIC-INDIC DIGIT SIX}",
        "FrequencyDivisor:",
        "FrequencyDivisor:0",
        "FrequencyDivisor:-4",
        "FrequencyDivisor:2.5",
        "FrequencyDivisor:four",
        "Period:10",
        ":",
    ],
)
def test_the_error_of_an_invalid_rate_shows_the_three_forms(rate: str) -> None:
    text = error_text(f"StreamFrames 3D {rate}".encode())
    assert rate[:10].lower() in text.lower()
    for word in ALL_RATES:
        assert word in text


@pytest.mark.parametrize(
    "parameters",
    ["Frequency:60 FrequencyDivisor:2", "AllFrames Frequency:60", "Frequency:60 3D Frequency:60"],
)
def test_the_error_of_a_second_rate_says_that_one_is_allowed(parameters: str) -> None:
    text = error_text(f"StreamFrames {parameters}".encode())
    assert "one of" in text
    for word in ALL_RATES:
        assert word in text


@pytest.mark.parametrize("parameters", ["Stop 3D", "3D Stop", "Frequency:60 Stop", "Stop Stop"])
def test_stop_with_another_parameter_is_an_error(parameters: str) -> None:
    assert "stop" in error_text(f"StreamFrames {parameters}".encode()).lower()


def test_bye_with_a_parameter_is_an_error() -> None:
    assert "no parameter" in error_text(b"Bye now")


# Bodies that are no command -------------------------------------------------------------------


@pytest.mark.parametrize("before", ["", "Version ", "SetByteOrder ", "SendParameters ", "SendCurrentFrame "])
@pytest.mark.parametrize(
    "word",
    [b"A" * 1_000_000, b"\xff" * 1_000_000, b"\x01" * 1000, b"'\"\\" * 1000, b"a\0" * 1000, b"\x80\x9f\xad"],
    ids=["letters", "all ones", "control characters", "quotes", "NULs", "Latin-1"],
)
def test_the_error_text_of_a_huge_or_binary_word_is_short_and_printable(before: str, word: bytes) -> None:
    error_text(before.encode() + word)
    error_text(before.encode() + word + b" " + word)


@pytest.mark.parametrize("body", [bytes(range(256)), b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc", b"\x80" * 7])
def test_a_binary_body_is_an_error(body: bytes) -> None:
    error_text(body)


def test_repeated_components_are_parsed_once_each() -> None:
    assert parse_command(b"StreamFrames" + b" 3D 6D" * 200_000) == StreamFrames(None, (MARKERS, TOOLS))


def test_a_file_name_is_kept_as_it_was_sent() -> None:
    command = parse_command(b"RECORDING START,file=C:\\My  takes\\A b.c3d\n")
    assert command == ControlRecording(start=True, options=",file=C:\\My  takes\\A b.c3d")
