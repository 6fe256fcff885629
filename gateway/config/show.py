"""The effective configuration as YAML with the origin of each value, and the JSON schema for editors."""

import json
import math
import os
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

import yaml
from pydantic.json_schema import GenerateJsonSchema

from gateway.config.document import Location
from gateway.config.loading import Configuration
from gateway.config.section import Section
from gateway.config.settings import Settings
from gateway.config.words import mask_secrets

_DEFAULT: Final = "default"
_MAX_COLUMN: Final = 48
"""The comments start here or earlier. After a longer line, the comment follows directly."""


class _Line(NamedTuple):
    text: str
    origin: str = ""


def shown_configuration(configuration: Configuration) -> str:
    """Return the effective configuration as YAML, with the origin of each value as a comment.

    Secrets are replaced by MASK. Values that depend on the environment (``lcm.url``, ``spool.directory``) are
    shown as they are in this one.
    """
    values = mask_secrets(configuration.settings.model_dump(mode="json"))
    origins = _Origins(configuration)
    origins.resolve(configuration.settings, values)
    lines = [line for key, value in values.items() for line in _lines(key, value, (key,), "", origins)]
    column = min(max(len(line.text) for line in lines), _MAX_COLUMN)
    return "".join(
        (f"{line.text:{column}}  # {line.origin}" if line.origin else line.text) + "\n" for line in lines
    )


class _Origins:
    """The origin of each value."""

    def __init__(self, configuration: Configuration) -> None:
        self._positions = configuration.positions
        self._resolved: dict[Location, str] = {}

    def resolve(self, settings: Settings, values: dict[str, Any]) -> None:
        """Replace keys without a value in ``values`` by the value in effect."""
        for source, shown in zip(settings.sources, values["sources"], strict=True):
            shown.update({key: effective.value for key, effective in source.effective.items()})
        for name in type(settings).model_fields:
            section = getattr(settings, name)
            if not isinstance(section, Section):
                continue
            for key, effective in section.effective.items():
                values[name][key] = effective.value
                if effective.variables:
                    self._resolved[name, key] = _variable(*effective.variables)

    def of(self, location: Location) -> str:
        """Return the origin of the value at ``location``, or several origins separated by commas."""
        if location in self._resolved:
            return self._resolved[location]
        # The items of a list on one line may come from several positions.
        positions = [
            position for other, position in self._positions.items() if other[: len(location)] == location
        ]
        return ", ".join(dict.fromkeys(position.without_column for position in positions)) or _DEFAULT


def _variable(*names: str) -> str:
    """Return the first of these environment variables that is set, or _DEFAULT."""
    return next((name for name in names if os.environ.get(name)), _DEFAULT)


def _lines(key: str, value: Any, location: Location, indent: str, origins: _Origins) -> Iterator[_Line]:
    """Yield the lines of one key. Mappings, and lists that hold any, get a line per item."""
    start = f"{indent}{_flow(key)}:"
    match value:
        case Mapping() if value:
            yield _Line(start)
            for inner, item in value.items():
                yield from _lines(inner, item, (*location, inner), indent + "  ", origins)
        case [*items] if any(isinstance(item, Mapping) and item for item in items):
            yield _Line(start)
            for index, item in enumerate(items):
                yield from _item_lines(item, (*location, index), indent + "  ", origins)
        case _:
            yield _Line(f"{start} {_flow(value)}", origins.of(location))


def _item_lines(item: Any, location: Location, indent: str, origins: _Origins) -> Iterator[_Line]:
    """Yield the lines of one item of a list that holds mappings."""
    if not isinstance(item, Mapping) or not item:
        yield _Line(f"{indent}- {_flow(item)}", origins.of(location))
        return
    begin = f"{indent}- "
    for inner, value in item.items():
        for line in _lines(inner, value, (*location, inner), indent + "  ", origins):
            yield line._replace(text=begin + line.text[len(begin) :])
            begin = indent + "  "


def _flow(value: Any) -> str:
    """Return ``value`` as YAML on one line."""
    if isinstance(value, str) and not value.isprintable():
        return json.dumps(value)
    text: str = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True, width=math.inf)
    return text.removesuffix("...\n").strip()


_DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"


class _WithoutTitles(GenerateJsonSchema):
    """Omits the titles of keys, which only repeat the key."""

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ARG002 - no key has one
        return False


def schema_text(model: type[Settings]) -> str:
    """Return the JSON schema of ``model``, the content of ``config/gateway.schema.json``."""
    schema = model.model_json_schema(schema_generator=_WithoutTitles)
    return json.dumps({"$schema": _DIALECT, **schema, "title": "RTC3D gateway"}, indent=2) + "\n"
