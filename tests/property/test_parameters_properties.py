"""Parameters (§6) with generated input: encoding and parsing are inverse, and no bytes crash the parser."""

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
    """Return parameters with ``texts``, and with ``words`` where an empty text would be read as a default."""
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


# Characters that XML can represent; the parser drops white space around texts.
_CHARACTERS = st.characters(
    exclude_categories=("Cc", "Cs"), include_characters="\t\n\r", exclude_characters="\ufffe\uffff"
)
TEXTS = st.text(_CHARACTERS, max_size=8).map(str.strip)
READABLE = parameters(TEXTS, TEXTS.filter(bool))
ANY = parameters(st.text(max_size=8), st.text(max_size=8))


MARKUP = [
    *b"< > </Marker> <Label> & &#0; <!-- <![CDATA[ <?xml </RT_Parameters> \x01".split(),
    b"<!DOCTYPE a [",
]


def parse_or_refuse(xml: bytes) -> None:
    """Parse ``xml``; any exception except ParametersError fails the test."""
    try:
        found, recovered = parse_parameters(xml)
    except ParametersError:
        return
    assert len(recovered) <= MAX_RECOVERED
    encode_parameters(found)


@given(READABLE)
def test_parsing_encoded_parameters_returns_them_without_faults(original: Parameters) -> None:
    assert parse_parameters(encode_parameters(original)) == (original, ())


@given(ANY)
def test_any_texts_are_encoded_as_well_formed_xml(original: Parameters) -> None:
    assert parse_parameters(encode_parameters(original)).recovered == ()


@given(st.binary())
@example(b"<")
@example(b"\xff\xfe<\0")
def test_any_bytes_are_parsed_or_raise_an_error(xml: bytes) -> None:
    parse_or_refuse(xml)


@given(
    READABLE.map(encode_parameters),
    st.lists(
        st.tuples(st.floats(0, 1), st.integers(0, 40), st.binary(max_size=8) | st.sampled_from(MARKUP)),
        min_size=1,
        max_size=5,
    ),
)
def test_damaged_xml_is_parsed_or_raises_an_error(xml: bytes, faults: list[tuple[float, int, bytes]]) -> None:
    for place, removed, inserted in faults:
        start = int(place * len(xml))
        xml = xml[:start] + inserted + xml[start + removed :]
    parse_or_refuse(xml)


@given(READABLE, st.floats(0, 1), st.sampled_from([0, 2]))
def test_a_missing_or_doubled_end_tag_after_a_value_loses_nothing(
    original: Parameters, place: float, times: int
) -> None:
    values = list(re.finditer(rb"<(\w+)[^>/]*>[^<]*(?P<end></\1>)", encode_parameters(original)))
    assume(values)
    value = values[round(place * (len(values) - 1))]
    xml = value.string[: value.start("end")] + value["end"] * times + value.string[value.end() :]
    found, recovered = parse_parameters(xml)
    assert found == original
    assert recovered
