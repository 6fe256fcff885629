"""What is read of a take in one pass: the moments of the chosen source and range, and their parameters."""

import math
from pathlib import Path

import pytest

from gateway.rtc3d.components import ComponentType
from gateway.simulator.take_moments import Moment, RecordedParameters
from gateway.simulator.take_pass import PlayedSource, TakePass
from gateway.takes.files.reader import TakeReader
from tests.support.takes import START_UTIME, Message, description, markers, parameters, write_take

FIRST = b"<RT_Parameters><General><Name>first</Name></General></RT_Parameters>"
SECOND = b"<RT_Parameters><General><Name>second</Name></General></RT_Parameters>"
DEFAULT = RecordedParameters(b"<RT_Parameters/>")


def read(
    path: Path, messages: list[Message], first_utime: float = -math.inf, end_utime: float = math.inf
) -> tuple[list[Moment], TakePass]:
    reader = TakeReader(write_take(path, messages))
    found = TakePass(PlayedSource(reader, "lab", first_utime, end_utime, DEFAULT))
    return list(found.moments()), found


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "take.lcmlog"


def test_moments_have_the_content_of_the_messages_from_byte_40_on(path: Path) -> None:
    messages = [description(), *(markers(3, number) for number in range(5))]
    moments, _ = read(path, messages)
    assert [moment.contents[ComponentType.MARKERS] for moment in moments] == [
        message[40:] for _, message in messages[1:]
    ]
    assert [moment.due_us for moment in moments] == [0, 10_000, 20_000, 30_000, 40_000]


def test_only_the_chosen_source_and_range_are_read(path: Path) -> None:
    """A range begins anywhere, and its end is not included."""
    others = [description("other"), markers(3, 30, source="other")]
    messages = [*others, *(markers(3, number) for number in range(100))]
    moments, _ = read(path, messages, START_UTIME + 200_000, START_UTIME + 500_000)
    assert [moment.timestamp_us for moment in moments] == list(range(200_000, 500_000, 10_000))
    assert moments[0].due_us == 0


def test_each_frame_has_the_parameters_that_were_valid(path: Path) -> None:
    messages = [
        markers(3, 0, version=0),
        parameters(FIRST, 1),
        markers(3, 1, version=1),
        parameters(SECOND, 2),
        markers(3, 2, version=1),  # arrived before the change
        markers(3, 3, version=2),
        parameters(SECOND, 2),  # repeated every few seconds
        markers(3, 4, version=3),  # whose parameters are missing
        parameters(b"", 4),  # void
        markers(3, 5, version=4),
    ]
    moments, found = read(path, messages)
    expected = [DEFAULT.xml, FIRST, FIRST, SECOND, SECOND, DEFAULT.xml]
    assert [moment.parameters.xml for moment in moments] == expected
    assert found.first_parameters is not None
    assert found.first_parameters.xml == FIRST


def test_a_thousand_versions_of_the_parameters_are_remembered_at_most(path: Path) -> None:
    """A faulty server can change them all the time; the newest ones are kept."""
    changes = [parameters(FIRST if number % 2 else SECOND, number) for number in range(1, 1600)]
    moments, found = read(path, [*changes, markers(3, 0, version=1599), markers(3, 1, version=1)])
    assert 500 <= len(found._versions) <= 1000
    assert [moment.parameters.xml for moment in moments] == [FIRST, FIRST]
    assert (min(found._versions), max(found._versions)) == (1001, 1599)


@pytest.mark.parametrize("encoding", ["ISO-8859-1", "latin1", "UTF-8"])
def test_xml_keeps_the_encoding_that_it_declares(path: Path, encoding: str) -> None:
    xml = f'<?xml version="1.0" encoding="{encoding}"?><RT_Parameters><Größe/></RT_Parameters>'
    messages = [parameters(xml.encode(), 1), markers(3, 0, version=1)]
    [moment], _ = read(path, messages)
    assert moment.parameters.xml == xml.encode(encoding)


def test_malformed_messages_are_left_out_and_counted(path: Path) -> None:
    channel, message = markers(3, 1)
    parameters_channel, parameters_message = parameters(FIRST)
    malformed = (message[:-1], message + b"\0", message[:52] + b"\xff" * 4 + message[56:], message[:20])
    others = [(channel, each) for each in malformed] + [(parameters_channel, parameters_message[:-5])]
    moments, found = read(path, [markers(3, 0), *others, markers(3, 2)])
    assert ([moment.timestamp_us for moment in moments], found.num_malformed) == ([0, 20_000], 5)


def test_a_capture_time_that_cannot_be_true_is_not_used(path: Path) -> None:
    broken = [
        (channel, message[:16] + bytes(8) + message[24:])
        for channel, message in (markers(3, number, timestamp_us=0) for number in range(5))
    ]
    moments, _ = read(path, broken)
    assert [moment.due_us for moment in moments] == [0, 10_000, 20_000, 30_000, 40_000]


def test_a_thousand_layouts_are_read_as_they_are(path: Path) -> None:
    messages = [markers(number % 1000, number) for number in range(2000)]
    moments, found = read(path, messages)
    assert [moment.contents[ComponentType.MARKERS] for moment in moments] == [
        each[1][40:] for each in messages
    ]
    assert found.num_malformed == 0
