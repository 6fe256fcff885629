"""The complete texts of errors, as a person reads them in a log or in a client program."""

import struct

import pytest

from gateway.errors import CommandError, FrameError, ParametersError
from gateway.rtc3d.commands import parse_command
from gateway.rtc3d.frames import split_frame
from gateway.rtc3d.packets import PacketReader
from gateway.rtc3d.parameters import General, Parameters
from gateway.rtc3d.parameters_xml import MAX_XML_BYTES, parse_parameters


def size_error(header: bytes) -> str:
    reader = PacketReader(max_packet_bytes=100)
    reader.feed(header)
    return str(reader.error)


def test_the_error_of_a_packet_that_is_too_large() -> None:
    assert size_error(b"\0\0\0\x65\0\0\0\x03") == (
        "packet size 101 (limit 100), type 3, at byte 0 of the stream: "
        "this is not an RTC3D server, or the connection is corrupt; check host and port"
    )


def test_the_error_of_a_packet_that_is_shorter_than_its_header() -> None:
    assert size_error(b"\0\0\0\x07\0\0\0\x01") == (
        "packet size 7 (less than the header's 8), type 1, at byte 0 of the stream: "
        "this is not an RTC3D server, or the connection is corrupt; check host and port"
    )


@pytest.mark.parametrize(
    ("command", "text"),
    [
        ("Version", "Version takes one parameter n.n, as in: Version 1.0"),
        ("SetByteOrder", "SetByteOrder takes one parameter, BigEndian or LittleEndian"),
        (
            "SendParameters 7D",
            "Unknown section '7d'; known are All, General, 3D, 6D, Analog, Force, Events, Event",
        ),
        (
            "SendCurrentFrame 7D",
            "Unknown component '7d'; known are All, 3D, 6D, Analog, Force, Events, Event",
        ),
        (
            "StreamFrames 7D",
            "Unknown parameter '7d'; known are All, 3D, 6D, Analog, Force, Events, Event, "
            "FrequencyDivisor:n, Frequency:n, AllFrames, Stop (alone)",
        ),
        (
            "StreamFrames AllFrames Frequency:60",
            "StreamFrames takes one of FrequencyDivisor:n, Frequency:n, AllFrames",
        ),
        (
            "StreamFrames Frequency:1:2",
            "Unknown rate 'frequency:1:2'; known are FrequencyDivisor:n (n a whole number from 1), "
            "Frequency:n (n Hz, above 0), AllFrames",
        ),
        ("Bye 3D", "Bye takes no parameter"),
    ],
)
def test_the_error_of_a_command_that_cannot_be_parsed(command: str, text: str) -> None:
    with pytest.raises(CommandError) as caught:
        parse_command(command.encode("ascii"))
    assert str(caught.value) == text


@pytest.mark.parametrize(
    ("word", "shown"),
    [("x" * 39, "x" * 39), ("x" * 40, "x" * 40), ("x" * 41, "x" * 40 + "?"), ("é", "?"), ("\x01", r"\x01")],
    ids=["39 characters", "40 characters", "41 characters", "beyond ASCII", "unprintable"],
)
def test_an_unknown_command_is_quoted_with_up_to_40_printable_characters(word: str, shown: str) -> None:
    with pytest.raises(CommandError) as caught:
        parse_command(word.encode("latin-1"))
    assert str(caught.value) == (
        f"Unknown command '{shown}'; "
        "known are Version, SetByteOrder, SendParameters, SendCurrentFrame, StreamFrames, Bye"
    )


def frame_error(body: str) -> str:
    with pytest.raises(FrameError) as caught:
        split_frame(bytes.fromhex(body), "big")
    return str(caught.value)


def test_a_frame_that_ends_before_its_components() -> None:
    assert frame_error("00000002 0000000c 00000063 00000000 00000000") == (
        "data frame announces 2 components; its 20 bytes end after 1"
    )


def test_a_component_that_is_longer_than_the_frame() -> None:
    assert frame_error("00000002 00000008 00000063 0000000c 00000064") == (
        "component 2 of 2 (type 100) has size 12; 8 bytes are left in the frame"
    )


@pytest.mark.parametrize(("num_items", "size"), [(1, 24), (0, 8), (0, 23)])
def test_a_component_whose_size_and_count_contradict_each_other(num_items: int, size: int) -> None:
    component = struct.pack(">IIiqI", size, 1, 7, 7000, num_items)[:size]
    announced = num_items if size == 24 else 0
    assert frame_error((b"\0\0\0\1" + component).hex()) == (
        f"3d component of {size} bytes announces {announced} items"
    )


def parameters_error(xml: bytes) -> str:
    with pytest.raises(ParametersError) as caught:
        parse_parameters(xml)
    return str(caught.value)


def test_parameters_that_are_too_large() -> None:
    assert parameters_error(b"x" * (MAX_XML_BYTES + 1)) == (
        f"the server's parameters take {MAX_XML_BYTES + 1} bytes, above the limit of {MAX_XML_BYTES}: "
        "this is not an RTC3D server, or it is faulty; check host and port"
    )


def test_parameters_of_exactly_the_largest_size_are_read() -> None:
    start, end = b"<RT_Parameters><General>", b"</General></RT_Parameters>"
    xml = start + b" " * (MAX_XML_BYTES - len(start) - len(end)) + end
    assert len(xml) == MAX_XML_BYTES
    assert parse_parameters(xml).parameters == Parameters(general=General())


def test_parameters_with_entities() -> None:
    assert parameters_error(b"<!DOCTYPE x [<!ENTITY e 'metre'>]><RT_Parameters/>") == (
        "the server's parameters declare XML entities, which RTC3D does not have, so they are not read; "
        "check host and port"
    )


@pytest.mark.parametrize(("length", "ending"), [(60, "'"), (61, "…'")])
def test_xml_without_parameters_is_shown_up_to_60_characters(length: int, ending: str) -> None:
    assert parameters_error(b"x" * length) == (
        f"the server's XML has no parameters but begins with '{'x' * 60}{ending}; "
        "check host and port, and that this is an RTC3D server"
    )
