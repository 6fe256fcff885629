"""What the log says about parameters that changed."""

from dataclasses import replace
from typing import Any

import pytest

from gateway.rtc3d.parameters import Marker, Parameters, Parameters3D, Parameters6D, Tool, without_statistics
from gateway.rtc3d.parameters_changes import (
    changed_sections,
    describe_renames,
    differ_in_statistics_only,
    statistics_xml,
)
from gateway.rtc3d.parameters_xml import parse_parameters
from tests.spec_parameters import ALL, ANALOG, GENERAL, spec_xml


def scene(markers: str = "", tools: str = "", **section: Any) -> Parameters:
    return Parameters(
        markers=Parameters3D(markers=tuple(Marker(str(n), label) for n, label in enumerate(markers, 1))),
        tools=Parameters6D(tools=tuple(Tool(str(n), label) for n, label in enumerate(tools, 1))),
        **section,
    )


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (scene("AB"), scene("AB"), ""),
        (scene("AB"), scene("AC"), "3d 'B' to 'C'"),
        (scene("AB", "XY"), scene("BA", "XZ"), "3d 'A' to 'B', 'B' to 'A'; 6d 'Y' to 'Z'"),
        (scene("ABCDEF"), scene("abcdef"), "3d 'A' to 'a', 'B' to 'b', 'C' to 'c' and 3 more"),
        (scene("ABC"), scene("abc"), "3d 'A' to 'a', 'B' to 'b', 'C' to 'c'"),
        (scene("AB"), scene("ABC"), ""),
        (scene("AB"), Parameters(), ""),
        (Parameters(), scene("AB"), ""),
    ],
)
def test_renamed_items_are_described(before: Parameters, after: Parameters, expected: str) -> None:
    assert describe_renames(before, after) == expected


def test_names_are_short_and_printable() -> None:
    text = describe_renames(
        scene("A"), Parameters(markers=Parameters3D(markers=(Marker("1", "\n\x1b" * 99),)))
    )
    assert text == "3d 'A' to '" + r"\n\x1b" * 20 + "…'"
    assert "'Ä'" in describe_renames(scene("A"), scene("Ä"))


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (ALL, ALL, []),
        (ALL, replace(ALL, general=replace(GENERAL, frames_sent=7, frames_per_s=7.0)), []),
        (ALL, replace(ALL, general=replace(GENERAL, name="Other")), ["general"]),
        (ALL, replace(ALL, analog=None), ["analog"]),
        (scene("AB", "X"), scene("BA", "Y"), []),
        (scene("AB", "X"), scene("ABC", "X", analog=ANALOG), ["3d", "analog"]),
        (scene("AB"), Parameters(markers=replace(scene("AB").markers, unit="m")), ["3d", "6d"]),  # type: ignore[type-var]
    ],
)
def test_other_changes_are_named_by_section(
    before: Parameters, after: Parameters, expected: list[str]
) -> None:
    assert changed_sections(before, after) == expected


def test_statistics_are_left_out() -> None:
    other = replace(ALL, general=replace(GENERAL, frames_sent=7, frames_per_s=7.0))
    assert without_statistics(ALL) == without_statistics(other) != ALL
    assert without_statistics(Parameters()) == Parameters()


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (b"<a><Stats>1</Stats></a>", b"<a><Stats>22</Stats></a>", True),
        (b"<a><Stats>1</Stats></a>", b"<a><Stats>1</Stats><b/></a>", False),
        (b"<a><Stats>1</Stats></a>", b"<a><Stats>1</a>", False),
        (b"<a><Stats>1</Stats></a>", b"<a></a>", True),
        (b"<a/>", b"<a/>", True),
        (b"<a/>", b"<b/>", False),
    ],
)
def test_replies_that_differ_in_their_statistics_are_recognised_unparsed(
    before: bytes, after: bytes, expected: bool
) -> None:
    assert differ_in_statistics_only(before, after) is expected


def test_statistics_can_be_read_alone() -> None:
    general = parse_parameters(statistics_xml(spec_xml("general"))).parameters.general
    assert general is not None
    assert (general.frames_sent, general.frames_per_s) == (GENERAL.frames_sent, GENERAL.frames_per_s)
    assert statistics_xml(spec_xml("3d")) == b""
