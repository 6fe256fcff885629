"""The table of the parameters' sections, and what they say about one component."""

import pytest

from gateway.rtc3d.component_types import ComponentType
from gateway.rtc3d.parameters import (
    SECTIONS,
    AnalogChannel,
    Parameters,
    Parameters3D,
    ParametersAnalog,
    ParametersForce,
    Plate,
    sections_of,
)
from gateway.rtc3d.server_description import described_labels, described_rate_hz, num_described_items
from tests.spec_parameters import ALL, BY_SECTION


def test_sections_have_the_names_of_section_5_3_3_in_commands() -> None:
    assert {key: section.command_word for key, section in SECTIONS.items()} == {
        "general": "General",
        "3d": "3D",
        "6d": "6D",
        "analog": "Analog",
        "force": "Force",
        "events": "Events",
    }


def test_every_field_of_the_parameters_is_a_section() -> None:
    assert [section.field for section in SECTIONS.values()] == list(Parameters.__dataclass_fields__)


def test_a_section_of_the_parameters_is_found_by_its_key() -> None:
    for key, parameters in BY_SECTION.items():
        assert SECTIONS[key].of(parameters) == SECTIONS[key].of(ALL)
        assert SECTIONS[key].of(parameters) is not None
        assert SECTIONS[key].of(Parameters()) is None


def test_the_unit_of_length_is_that_of_the_markers_and_mm_by_default() -> None:
    assert Parameters().length_unit == "mm"
    assert Parameters(markers=Parameters3D(unit="m")).length_unit == "m"


def test_the_sections_that_a_server_sent_are_found() -> None:
    assert sections_of(ALL) == set(SECTIONS)
    assert sections_of(Parameters()) == frozenset()
    for key, parameters in BY_SECTION.items():
        assert sections_of(parameters) == {key}


def test_a_component_is_described_by_its_own_section() -> None:
    """Rates set time-outs, and numbers of items are compared with those in frames."""
    described = {
        kind: (described_rate_hz(ALL, kind), num_described_items(ALL, kind), described_labels(ALL, kind))
        for kind in ComponentType
    }
    assert described == {
        ComponentType.MARKERS: (60.0, 1, ["marker 1"]),
        ComponentType.TOOLS: (60.0, 1, [""]),
        ComponentType.ANALOG: (2400.0, 1, []),
        ComponentType.FORCE: (2400.0, 1, []),
        ComponentType.EVENT: (None, 0, []),
    }
    for kind in ComponentType:
        assert described_rate_hz(Parameters(), kind) is None
        assert num_described_items(Parameters(), kind) == 0
        assert described_labels(Parameters(), kind) == []


@pytest.mark.parametrize(
    ("rate_hz", "expected"),
    [(None, None), (0.0, None), (0.0099, None), (0.01, 0.01), (1e6, 1e6), (1.1e6, None), (-60.0, None)],
)
def test_a_number_that_cannot_be_a_rate_counts_as_none(rate_hz: float | None, expected: float | None) -> None:
    """Some servers send 0 for what they do not measure; a time-out of 1 / 0 s would never end."""
    assert described_rate_hz(Parameters(markers=Parameters3D(rate_hz)), ComponentType.MARKERS) == expected


def test_the_highest_rate_of_channels_and_plates_counts() -> None:
    """A component is sent as often as its fastest item is sampled."""
    rates_hz = (100.0, 2000.0, None, 1000.0)
    channels = tuple(AnalogChannel("1", frequency_hz=rate_hz) for rate_hz in rates_hz)
    plates = tuple(Plate("1", frequency_hz=rate_hz) for rate_hz in rates_hz)
    parameters = Parameters(analog=ParametersAnalog(channels), force=ParametersForce(plates))
    assert described_rate_hz(parameters, ComponentType.ANALOG) == 2000.0
    assert described_rate_hz(parameters, ComponentType.FORCE) == 2000.0
