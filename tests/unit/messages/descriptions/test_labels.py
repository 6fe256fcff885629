"""Labels, units and rates of components."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.messages.descriptions.labels import describe, event_labels, event_time_us
from gateway.messages.topics import MAX_LABEL_LENGTH, unique_name
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    ForceChannel,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersEvents,
    ParametersForce,
    Plate,
    Tool,
)


@given(st.lists(st.sampled_from(["", "a", " a ", "a_2", "tool 3", "x" * 300, "x" * 299 + "y"]), max_size=8))
def test_labels_are_those_of_the_keys_of_tools(labels: list[str]) -> None:
    tools = tuple(Tool(str(number), label) for number, label in enumerate(labels))
    names: dict[str, None] = {}
    for number, label in enumerate(labels, start=1):
        names[unique_name(label.strip() or f"tool {number}", names, MAX_LABEL_LENGTH)] = None
    found = describe(ComponentType.TOOLS, Parameters(tools=Parameters6D(tools=tools)), len(labels))
    assert found.labels == tuple(names)


def test_items_without_labels_are_called_by_their_position_and_other_labels_left_out() -> None:
    channels = (AnalogChannel("1", "EMG", unit="V", frequency_hz=1000.0),)
    found = describe(ComponentType.ANALOG, Parameters(analog=ParametersAnalog(channels)), 2)
    assert (found.labels, found.units) == (("EMG", "channel 2"), ("V", "mV"))
    assert (found.unit, found.rate_hz) == ("", 1000)
    assert describe(ComponentType.MARKERS, None, 2).labels == ("marker 1", "marker 2")
    assert describe(ComponentType.FORCE, None, 1).labels == ("plate 1",)
    assert describe(ComponentType.EVENT, None, 1).labels == ()
    tools = Parameters(tools=Parameters6D(100.0, (Tool("1", "a"), Tool("2", "b"))))
    assert describe(ComponentType.TOOLS, tools, 1).labels == ("a",)


def test_positions_of_tools_have_the_unit_of_the_markers() -> None:
    assert describe(ComponentType.TOOLS, Parameters(markers=Parameters3D(unit="m")), 1).unit == "m"
    assert describe(ComponentType.TOOLS, None, 1).unit == "mm"


def test_different_rates_and_units_have_no_common_one() -> None:
    channels = (ForceChannel("1", unit="N"),) * 3 + (ForceChannel("4", unit="Nmm"),) * 3
    plates = (Plate("1", "a", 1000.0, channels=channels), Plate("2", "b", 2000.0))
    found = describe(ComponentType.FORCE, Parameters(force=ParametersForce(plates)), 2)
    assert (found.units, found.unit, found.moment_unit, found.rate_hz) == (("N", ""), "", "", None)
    found = describe(ComponentType.FORCE, Parameters(force=ParametersForce(plates[:1])), 1)
    assert (found.unit, found.moment_unit, found.rate_hz) == ("N", "Nmm", 1000)


def test_ids_of_events_are_decimal_or_hexadecimal() -> None:
    ids = (
        ("0x10", "a"),
        ("17", "b"),
        ("0xFFFFFFFF", "c"),
        ("abc", "d"),
        ("3", ""),
        ("17", "x"),
        ("0X12", "e"),
    )
    events = tuple(EventDefinition(event_id, label) for event_id, label in ids)
    assert event_labels(Parameters(events=ParametersEvents(events))) == {16: "a", 17: "b", -1: "c", 18: "e"}
    assert event_labels(None) == {}


@pytest.mark.parametrize(
    ("event_us", "expected_us"),
    [
        (7_000_000, 500),
        (6_999_700, 200),
        (7_000_300, 800),
        (6_000_000, -999_500),
        (8_000_000, 1_000_500),
        (5_999_999, 500),
        (8_000_001, 500),
        (0, 500),
    ],
)
def test_an_event_has_its_own_time_if_that_is_within_a_second_of_its_frame(
    event_us: int, expected_us: int
) -> None:
    assert event_time_us(500, 7_000_000, event_us) == expected_us
