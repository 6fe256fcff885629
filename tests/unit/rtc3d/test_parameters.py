"""The table of the parameters' sections."""

from gateway.rtc3d.parameters import SECTIONS, Parameters, Parameters3D, sections_of
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
