import string

from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.errors import CommandError
from gateway.rtc3d.commands import (
    AllFrames,
    Bye,
    Command,
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
from gateway.rtc3d.parameters import SECTIONS
from tests.support.examples import examples
from tests.support.strategies import damaged

digits = st.text(string.digits, min_size=1, max_size=4)
component_lists = st.lists(st.sampled_from(ComponentType), unique=True).map(tuple)
section_lists = st.lists(st.sampled_from(list(SECTIONS)), unique=True).map(tuple)
# A frequency has at most nine digits before the point and six after it.
frequencies = st.integers(1, 10**15 - 1).map(lambda millionths: Frequency(millionths / 1e6))
divisors = st.integers(1, 10**9 - 1).map(FrequencyDivisor)
rates = st.none() | st.just(AllFrames()) | frequencies | divisors

commands: st.SearchStrategy[Command] = st.one_of(
    st.builds("{}.{}".format, digits, digits).map(Version),
    st.sampled_from([SetByteOrder("big"), SetByteOrder("little"), StopStreaming(), Bye()]),
    section_lists.map(SendParameters),
    component_lists.map(SendCurrentFrame),
    st.builds(StreamFrames, rates, component_lists),
)
bodies = commands.map(encode_command)

# Random lists of the protocol's words reach more of the parser than random bytes.
WORDS = [
    *["Version", "SetByteOrder", "SendParameters", "SendCurrentFrame", "StreamFrames", "Bye"],
    *["1.0", "BigEndian", "LittleEndian", "Stop", "\xe9"],
    *["All", "General", "3D", "6D", "Analog", "Force", "Event", "Events"],
    *["AllFrames", "Frequency:60", "FrequencyDivisor:4"],
    *["Frequency:", "Frequency:1e9", "FrequencyDivisor:0", "Frequency:\xb2", ":"],
]
word_lists = st.lists(st.sampled_from(WORDS), max_size=6).map(lambda words: " ".join(words).encode("latin-1"))


@given(commands)
def test_a_command_is_parsed_from_its_text(command: Command) -> None:
    assert parse_command(str(command).encode("ascii")) == command
    assert encode_command(command) == str(command).encode("ascii")


@given(bodies, st.data(), st.text(" \0\t\r\n", max_size=6))
def test_case_and_ending_do_not_change_a_command(body: bytes, data: st.DataObject, end: str) -> None:
    text = body.decode("ascii")
    upper = data.draw(st.lists(st.booleans(), min_size=len(text), max_size=len(text)))
    mixed = "".join(letter.upper() if up else letter.lower() for letter, up in zip(text, upper, strict=True))
    assert parse_command((mixed + end).encode("ascii")) == parse_command(body)


@settings(max_examples=examples(300))
@given(st.binary(max_size=200) | damaged(bodies) | word_lists | damaged(word_lists))
def test_any_bytes_are_a_command_or_raise_an_error_with_a_short_ascii_text(body: bytes) -> None:
    try:
        command = parse_command(body)
    except CommandError as error:
        text = str(error)
        assert text
        assert text.isascii()
        assert text.isprintable()
        assert len(text) < 300
    else:
        assert parse_command(encode_command(command)) == command
