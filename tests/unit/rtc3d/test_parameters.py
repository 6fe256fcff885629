"""The sections of the parameters, what they say about one component, and what the log says of changes."""

from dataclasses import replace
from typing import Any

import pytest

from gateway.rtc3d.component_types import ComponentType
from gateway.rtc3d.components import described_labels, described_rate_hz, num_described_items, only_components
from gateway.rtc3d.parameters import (
    SECTIONS,
    AnalogChannel,
    Marker,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersForce,
    Plate,
    Tool,
    changed_sections,
    describe_renames,
    differ_in_statistics_only,
    sections_of,
    statistics_xml,
    without_statistics,
)
from gateway.rtc3d.parameters_xml import parse_parameters
from tests.support.parameters import ALL, ANALOG, BY_SECTION, GENERAL, spec_xml


def test_sections_have_the_words_of_section_5_3_3_and_are_found_by_their_keys() -> None:
    words = {key: section.command_word for key, section in SECTIONS.items()}
    assert list(words.items()) == [
        *(("general", "General"), ("3d", "3D"), ("6d", "6D")),
        *(("analog", "Analog"), ("force", "Force"), ("events", "Events")),
    ]
    assert [section.field for section in SECTIONS.values()] == list(Parameters.__dataclass_fields__)
    for key, parameters in BY_SECTION.items():
        assert SECTIONS[key].of(parameters) == SECTIONS[key].of(ALL) is not None
        assert SECTIONS[key].of(Parameters()) is None
        assert sections_of(parameters) == {key}
    assert [*map(len, map(sections_of, (ALL, Parameters())))] == [len(SECTIONS), 0]


def test_a_component_is_described_by_its_own_section() -> None:
    """Rates set time-outs, and numbers of items are compared with those in frames."""
    described = {
        ComponentType.MARKERS: (60.0, 1, ["marker 1"]),
        ComponentType.TOOLS: (60.0, 1, [""]),
        ComponentType.ANALOG: (2400.0, 1, []),
        ComponentType.FORCE: (2400.0, 1, []),
        ComponentType.EVENT: (None, 0, []),
    }
    for parameters, expected in (
        (ALL, described),
        (Parameters(), dict.fromkeys(ComponentType, (None, 0, []))),
    ):
        for kind in ComponentType:
            counts = (num_described_items(parameters, kind), described_labels(parameters, kind))
            assert (described_rate_hz(parameters, kind), *counts) == expected[kind]
    assert Parameters().length_unit == "mm"
    assert Parameters(markers=Parameters3D(unit="m")).length_unit == "m"


@pytest.mark.parametrize("kinds", [{each} for each in ComponentType] + [set(), set(ComponentType)])
def test_only_components_have_items_but_all_have_the_unit(kinds: set[ComponentType]) -> None:
    """The unit of tools is in the section of markers. Outputs open nothing for what nobody requests."""
    given = replace(ALL, markers=Parameters3D(unit="m", markers=(Marker("1"),)))
    kept = only_components(given, kinds)
    assert (kept.general, kept.length_unit) == (given.general, "m")
    for kind in ComponentType:
        expected = num_described_items(given, kind) if kind in kinds else 0
        assert num_described_items(kept, kind) == expected
    assert (kept.events == given.events) is (ComponentType.EVENT in kinds)
    assert only_components(Parameters(), kinds) == Parameters()


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


# Changes --------------------------------------------------------------------------------------


def scene(markers: str = "", tools: str = "", unit: str = "mm", **section: Any) -> Parameters:
    return Parameters(
        markers=Parameters3D(
            unit=unit, markers=tuple(Marker(str(n), each) for n, each in enumerate(markers, 1))
        ),
        tools=Parameters6D(tools=tuple(Tool(str(n), label) for n, label in enumerate(tools, 1))),
        **section,
    )


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (scene("AB"), scene("AB"), ""),
        (scene("AB", "XY"), scene("BA", "XZ"), "3d 'A' to 'B', 'B' to 'A'; 6d 'Y' to 'Z'"),
        (scene("ABCDEF"), scene("abcdef"), "3d 'A' to 'a', 'B' to 'b', 'C' to 'c' and 3 more"),
        (scene("ABC"), scene("abÄ"), "3d 'A' to 'a', 'B' to 'b', 'C' to 'Ä'"),
        (scene("AB"), scene("ABC"), ""),
        (scene("AB"), Parameters(), ""),
        (Parameters(), scene("AB"), ""),
        (
            scene("A"),
            Parameters(markers=Parameters3D(markers=(Marker("1", "\n\x1b" * 99),))),
            "3d 'A' to '" + r"\n\x1b" * 20 + "…'",
        ),
    ],
)
def test_renamed_items_are_described_in_short(before: Parameters, after: Parameters, expected: str) -> None:
    assert describe_renames(before, after) == expected


OTHER_STATISTICS = replace(ALL, general=replace(GENERAL, frames_sent=7, frames_per_s=7.0))


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (ALL, OTHER_STATISTICS, []),
        (ALL, replace(ALL, general=replace(GENERAL, name="Other")), ["general"]),
        (ALL, replace(ALL, analog=None), ["analog"]),
        (scene("AB", "X"), scene("BA", "Y"), []),
        (scene("AB", "X"), scene("ABC", "X", analog=ANALOG), ["3d", "analog"]),
        (scene("AB"), replace(scene("AB", unit="m"), tools=None), ["3d", "6d"]),
    ],
)
def test_other_changes_name_the_section(before: Parameters, after: Parameters, expected: list[str]) -> None:
    assert changed_sections(before, after) == expected


def test_statistics_are_left_out_or_read_alone() -> None:
    assert without_statistics(ALL) == without_statistics(OTHER_STATISTICS) != ALL
    assert without_statistics(Parameters()) == Parameters()
    general = parse_parameters(statistics_xml(spec_xml("general"))).parameters.general
    assert general is not None
    assert (general.frames_sent, general.frames_per_s) == (GENERAL.frames_sent, GENERAL.frames_per_s)
    assert statistics_xml(spec_xml("3d")) == b""


@pytest.mark.parametrize(
    ("after", "expected"),
    [
        (b"<a><Stats>22</Stats></a>", True),
        (b"<a><Stats>1</Stats><b/></a>", False),
        (b"<a><Stats>1</a>", False),
        (b"<a></a>", True),
        (b"<b/>", False),
    ],
)
def test_replies_that_differ_in_their_statistics_are_recognised(after: bytes, expected: bool) -> None:
    assert differ_in_statistics_only(b"<a><Stats>1</Stats></a>", after) is expected
