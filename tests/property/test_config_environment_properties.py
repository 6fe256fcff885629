import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.config.document import VARIABLE_PREFIX, Location, variable_name
from gateway.config.settings import Settings
from gateway.errors import ConfigError
from tests.property.test_config_properties import PIECES, SETTINGS
from tests.support.configurations import load
from tests.support.examples import examples


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("environment") / "lab.yaml"


def locations(value: Any, location: Location = ()) -> Iterator[tuple[Location, Any]]:
    """Yield every value in nested mappings and lists, except the root, with its path."""
    if location:
        yield location, value
    if isinstance(value, dict):
        for key, item in value.items():
            yield from locations(item, (*location, key))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from locations(item, (*location, index))


def as_text(value: object) -> str:
    return yaml.dump(value, Dumper=yaml.CSafeDumper, default_flow_style=True)


@given(configuration=SETTINGS, data=st.data())
def test_a_variable_has_the_effect_of_the_same_value_in_a_file(
    file: Path, configuration: Settings, data: st.DataObject
) -> None:
    """Whatever the file has in its place: nothing, another value, or another kind of value."""
    values = configuration.model_dump(mode="json", exclude_defaults=True)
    location, value = data.draw(st.sampled_from(list(locations(values))))
    rest = copy.deepcopy(values)
    container: Any = rest
    for step in location[:-1]:
        container = container[step]
    may_be_missing = isinstance(container, dict) or location[-1] == len(container) - 1
    if may_be_missing and data.draw(st.booleans()):
        del container[location[-1]]
    else:
        container[location[-1]] = data.draw(st.sampled_from([None, "other", 7, [], {}]))
    file.write_text(as_text(rest), encoding="utf-8")
    assert load(file, {variable_name(location): as_text(value)}) == configuration


@settings(max_examples=examples(50))  # each has some thirty variables
@given(configuration=SETTINGS)
def test_variables_can_set_everything_that_a_file_can(configuration: Settings) -> None:
    """A container needs no file."""
    values = configuration.model_dump(mode="json", exclude_defaults=True)
    variables = {
        variable_name(location): as_text(value)
        for location, value in locations(values)
        if not value or not isinstance(value, list | dict)
    }
    assert load(None, variables) == configuration


@given(
    variables=st.dictionaries(
        st.lists(
            st.sampled_from(["SOURCES", "0", "1", "LCM", "ZENOH", "CONFIG", "URL", "MODE", "", "Ä", "٣"]),
            max_size=4,
        ).map("__".join),
        st.lists(st.sampled_from(PIECES), max_size=10).map("".join) | st.text(),
        max_size=4,
    )
)
def test_any_variables_give_settings_or_lines_with_a_place(file: Path, variables: dict[str, str]) -> None:
    file.write_text("sources: [{name: lab, host: lab}]", encoding="utf-8")
    environ = {VARIABLE_PREFIX + name: value for name, value in variables.items()}
    try:
        configuration = load(file, environ)
    except ConfigError as error:
        positions = (f"{file}:", *(f"{name}: " for name in environ))
        lines = str(error).split("\n")
        assert all(line.startswith(positions) for line in lines)
    else:
        assert configuration.sources
