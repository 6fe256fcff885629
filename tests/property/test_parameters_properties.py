"""Parameters (§6) over generated input: what is built is read back, and no bytes bring the reader down."""

import re
from typing import TypeVar

from hypothesis import assume, example, given
from hypothesis import strategies as st

from gateway.errors import ParametersError
from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    EventParameter,
    ExpectedValue,
    ForceChannel,
    General,
    Marker,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersEvents,
    ParametersForce,
    Plate,
    Point,
    Tool,
)
from gateway.rtc3d.parameters_xml import MAX_RECOVERED, encode_parameters, parse_parameters

_T = TypeVar("_T")


def some(items: st.SearchStrategy[_T]) -> st.SearchStrategy[tuple[_T, ...]]:
    return st.lists(items, max_size=3).map(tuple)


def parameters(texts: st.SearchStrategy[str], words: st.SearchStrategy[str]) -> st.SearchStrategy[Parameters]:
    """Parameters with ``texts``, and ``words`` where a text that is empty reads as its default."""
    reals = st.floats(allow_nan=False, allow_infinity=False)
    numbers = st.none() | reals
    counts = st.none() | st.integers(0, 2**63)
    points = st.builds(Point, reals, reals, reals, words)
    plates = st.builds(
        Plate,
        texts,
        texts,
        numbers,
        some(points),
        st.none() | points,
        some(st.builds(ForceChannel, texts, texts, texts)),
        some(texts),
        numbers,
        numbers,
        texts,
        some(some(reals)),
    )
    values = st.builds(ExpectedValue, texts, texts, texts, texts)
    event_parameters = st.builds(EventParameter, texts, words, texts, some(values))
    events = st.builds(EventDefinition, texts, texts, texts, some(event_parameters))
    return st.builds(
        Parameters,
        st.none() | st.builds(General, texts, texts, texts, counts, counts, numbers),
        st.none() | st.builds(Parameters3D, numbers, words, some(st.builds(Marker, texts, texts, texts))),
        st.none() | st.builds(Parameters6D, numbers, some(st.builds(Tool, texts, texts, texts, some(texts)))),
        st.none()
        | st.builds(ParametersAnalog, some(st.builds(AnalogChannel, texts, texts, texts, words, numbers))),
        st.none() | st.builds(ParametersForce, some(plates)),
        st.none() | st.builds(ParametersEvents, some(events)),
    )


# What XML can hold, without the white space around it that the reader drops.
_CHARACTERS = st.characters(
    exclude_categories=("Cc", "Cs"), include_characters="\t\n\r", exclude_characters="\ufffe\uffff"
)
TEXTS = st.text(_CHARACTERS, max_size=8).map(str.strip)
READABLE = parameters(TEXTS, TEXTS.filter(bool))
ANY = parameters(st.text(max_size=8), st.text(max_size=8))


def read_or_refuse(xml: bytes) -> None:
    """Read ``xml``: any exception but ParametersError fails the test."""
    try:
        found, recovered = parse_parameters(xml)
    except ParametersError:
        return
    assert len(recovered) <= MAX_RECOVERED
    encode_parameters(found)


@given(READABLE)
def test_what_is_built_is_read_back_and_nothing_is_found_wrong(original: Parameters) -> None:
    assert parse_parameters(encode_parameters(original)) == (original, ())


@given(ANY)
def test_whatever_the_texts_hold_well_formed_xml_is_built(original: Parameters) -> None:
    assert parse_parameters(encode_parameters(original)).recovered == ()


@given(st.binary())
@example(b"<")
@example(b"\xff\xfe<\0")
def test_any_bytes_are_read_or_refused(xml: bytes) -> None:
    read_or_refuse(xml)


@given(
    READABLE.map(encode_parameters),
    st.lists(
        st.tuples(
            st.floats(0, 1),
            st.integers(0, 40),
            st.binary(max_size=8)
            | st.sampled_from(
                [
                    b"<",
                    b">",
                    b"</Marker>",
                    b"<Label>",
                    b"&",
                    b"&#0;",
                    b"<!--",
                    b"<![CDATA[",
                    b"<?xml",
                    b"<!DOCTYPE a [",
                    b"</RT_Parameters>",
                    b"\x01",
                ]
            ),
        ),
        min_size=1,
        max_size=5,
    ),
)
def test_garbled_xml_is_read_or_refused(xml: bytes, faults: list[tuple[float, int, bytes]]) -> None:
    for place, removed, inserted in faults:
        start = int(place * len(xml))
        xml = xml[:start] + inserted + xml[start + removed :]
    read_or_refuse(xml)


@given(READABLE, st.floats(0, 1), st.sampled_from([0, 2]))
def test_an_end_tag_left_out_or_doubled_after_a_value_loses_nothing(
    original: Parameters, place: float, times: int
) -> None:
    values = list(re.finditer(rb"<(\w+)[^>/]*>[^<]*(?P<end></\1>)", encode_parameters(original)))
    assume(values)
    value = values[round(place * (len(values) - 1))]
    xml = value.string[: value.start("end")] + value["end"] * times + value.string[value.end() :]
    found, recovered = parse_parameters(xml)
    assert found == original
    assert recovered
