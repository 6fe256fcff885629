"""Read settings from YAML files and environment variables, and show what is in effect and what is possible.

Every mistake is reported with its position.
"""

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import yaml
from pydantic import ValidationError
from pydantic.json_schema import GenerateJsonSchema

from gateway.config.document import (
    VARIABLE_PREFIX,
    Document,
    Location,
    Position,
    apply_overrides,
    line_and_column_after,
    read_yaml,
    variable_name,
)
from gateway.config.files import read_file
from gateway.config.section import UNKNOWN_KEY, Section, key_descriptions
from gateway.config.settings import OutputSettings, Settings
from gateway.config.words import find_secrets, replace_item
from gateway.errors import ConfigError
from gateway.rtc3d.commands import AllFrames
from gateway.rtc3d.components import WIRE_ORDER

_OLD_KEYS: Final[dict[Location, str]] = {("metrics", "address"): "write host instead"}
"""The keys of earlier versions that no longer exist, and what to do about each."""

AnySection = TypeVar("AnySection", bound=Section)


class Configuration(NamedTuple):
    """The settings, and the position of each value that is not a default."""

    settings: Settings
    positions: Mapping[Location, Position]


def read(path: Path | None, model: type[Settings], environ: Mapping[str, str] = os.environ) -> Configuration:
    """Read the YAML file at ``path``, if any, and apply the overrides in ``environ`` (config/document.py).

    ``model`` is the whole configuration with its outputs (``settings_model``). Relative paths are relative to
    the folder of the file, or to the current folder if there is no file. Raises ConfigError with one line per
    mistake, ``POSITION: KEY: what was found; what is expected``. The position is FILE:LINE:COLUMN or the name
    of the variable. If the YAML syntax is wrong, only the first mistake is reported.
    """
    if path is None:
        document = read_yaml("{}", "environment", has_lines=False)
        return _configuration(document, model, Path.cwd(), environ)
    document = _read_file(path, model, "config/gateway.yaml")
    return _configuration(document, model, path.parent.absolute(), environ)


def read_server(
    host: str, port: int, model: type[Settings], environ: Mapping[str, str] = os.environ
) -> Configuration:
    """Return the configuration of one server as source "lab"; the rest is default or from ``environ``.

    Raises ConfigError as ``read`` does, with the position ``--server``.
    """
    sources = json.dumps({"sources": [{"name": "lab", "host": host, "port": port}]})
    document = read_yaml(sources, "--server", has_lines=False)
    return _configuration(document, model, Path.cwd(), environ)


def load_as(section: type[AnySection], path: Path, *, example: str) -> AnySection:
    """Read the YAML file at ``path`` into a section; relative paths in it are relative to its folder.

    Raises ConfigError as ``read`` does. Its text suggests ``example`` if the file cannot be read.
    """
    document = _read_file(path, section, example)
    try:
        return section.model_validate(document.values, context={"folder": path.parent.absolute()})
    except ValidationError as error:
        raise _in_order(_explained(document, error)) from None


def _configuration(
    document: Document, model: type[Settings], folder: Path, environ: Mapping[str, str]
) -> Configuration:
    apply_overrides(document, environ)
    mistakes = [
        mistake
        for name, field in model.model_fields.items()
        if isinstance(field.annotation, type) and issubclass(field.annotation, OutputSettings)
        for key, safe_place in field.annotation.foreign_keys.items()
        for mistake in _mask_secrets(document, (name, key), safe_place)
    ]
    try:
        settings = model.model_validate(document.values, context={"folder": folder})
    except ValidationError as error:
        raise _in_order([*mistakes, *_explained(document, error)]) from None
    if mistakes:
        raise _in_order(mistakes)
    return Configuration(settings, document.positions)


def _read_file(path: Path, section: type[Section], example: str) -> Document:
    try:
        text = read_file(path).decode("utf-8-sig")  # some editors begin a file with a byte order mark
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read: {error.strerror}; name a YAML file such as {example}"
        ) from error
    except UnicodeDecodeError as error:
        position = Position(str(path), *line_and_column_after(error.object[: error.start].decode()))
        found = f"0x{error.object[error.start]:02X}"
        raise position.error((), f"found the byte {found}; expected text in UTF-8") from None
    document = read_yaml(text, str(path))
    if not document.positions:
        needed = next(name for name, field in section.model_fields.items() if field.is_required())
        raise ConfigError(f"{path}: empty; expected a mapping with at least the key {needed}")
    return document


_Mistake = tuple[Position, ConfigError]

_MAX_MISTAKES: Final = 20
"""How many mistakes an error lists; nobody reads more, and at a reload each is a line in the log."""


def _in_order(mistakes: list[_Mistake]) -> ConfigError:
    """Return the first mistakes as one error: those of the file by line, then those of variables."""
    ordered = sorted(mistakes, key=lambda mistake: (mistake[0].line == 0, *mistake[0], str(mistake[1])))
    lines = [str(error) for _, error in ordered[:_MAX_MISTAKES]]
    if len(ordered) > _MAX_MISTAKES:
        lines.append(f"and {len(ordered) - _MAX_MISTAKES} more mistakes; correct these first")
    return ConfigError("\n".join(lines))


def _explained(document: Document, error: ValidationError) -> list[_Mistake]:
    """Return the mistakes in a validation error, each with its position."""
    mistakes = []
    variables = [
        (location, position.origin)
        for location, position in document.positions.items()
        if position.origin.startswith(VARIABLE_PREFIX)
    ]
    for details in error.errors(include_url=False):
        location, text = details["loc"], details["msg"]
        if location in _OLD_KEYS:
            text = f"a key of earlier versions; {_OLD_KEYS[location]}"
        position = document.key_positions.get(location) if details["type"] == UNKNOWN_KEY else None
        position = position or document.nearest_position(location)
        names = {name for place, name in variables if place[: len(location)] == location}
        if names and position.line:  # one of the variables may have the mistake
            text += f" (a part of it is from {', '.join(sorted(names))})"
        mistakes.append((position, position.error(location, text)))
    return mistakes


def _mask_secrets(document: Document, foreign: Location, safe_place: str) -> list[_Mistake]:
    """Mask the secrets below ``foreign`` that are in the file itself, and return a mistake for each.

    Configuration files are shared and kept under version control, so they must not contain secrets. Masking
    keeps the secrets out of later error messages.
    """
    config = document.values
    for key in foreign:
        config = config.get(key) if isinstance(config, dict) else None
    mistakes = []
    for location, masked in list(find_secrets(config, foreign)):
        position = document.nearest_position(location)
        if not position.line:
            continue
        replace_item(document.values, location, masked)
        stem, _, form = str(location[-1]).rpartition("_")
        path_key = {"base64": stem, "pem": f"{stem}_file"}.get(form)  # such as connect_private_key
        others = f"{path_key} with the path of the key's file, " if stem and path_key else ""
        text = (
            f"found a secret, which does not belong in this file; use {others}"
            f"the environment variable {variable_name(location)}, or {safe_place}"
        )
        mistakes.append((position, position.error(location, text)))
    return mistakes


# The effective configuration as YAML with the origin of each value, and the JSON schema for editors.

_DEFAULT: Final = "default"
_MAX_COLUMN: Final = 48
"""The comments start here or earlier. After a longer line, the comment follows directly."""


def shown_configuration(configuration: Configuration) -> str:
    """Return the effective configuration as YAML, with the origin of each value as a comment.

    Secrets are replaced by MASK. Values that depend on the environment (``lcm.url``, ``spool.directory``) are
    shown as they are in this one.
    """
    settings = configuration.settings
    values = settings.model_dump(mode="json")
    for location, masked in list(find_secrets(values)):
        replace_item(values, location, masked)
    used: dict[Location, str] = {}  # the origins of values that are used because a key is not set
    sections: dict[Location, object] = {
        (name,): getattr(settings, name) for name in type(settings).model_fields
    }
    sections |= {("sources", index): source for index, source in enumerate(settings.sources)}
    for place, section in sections.items():
        for key, effective in section.effective.items() if isinstance(section, Section) else ():
            replace_item(values, (*place, key), effective.value)
            if effective.variables:
                set_by = (name for name in effective.variables if os.environ.get(name))
                used[(*place, key)] = next(set_by, _DEFAULT)

    def origin_of(location: Location) -> str:
        if location in used:
            return used[location]
        # The items of a list on one line may come from several positions.
        positions = [
            position
            for other, position in configuration.positions.items()
            if other[: len(location)] == location
        ]
        return ", ".join(dict.fromkeys(position.without_column for position in positions)) or _DEFAULT

    lines = [line for key, value in values.items() for line in _lines(key, value, (key,), "", origin_of)]
    column = min(max(len(text) for text, _ in lines), _MAX_COLUMN)
    return "".join((f"{text:{column}}  # {origin}" if origin else text) + "\n" for text, origin in lines)


def _lines(
    key: str, value: Any, location: Location, indent: str, origin_of: Callable[[Location], str]
) -> Iterator[tuple[str, str]]:
    """Yield the lines of a key and their origins. Mappings, and lists that hold any, get a line per item."""
    start = f"{indent}{_flow(key)}:"
    match value:
        case Mapping() if value:
            yield start, ""
            for inner, item in value.items():
                yield from _lines(inner, item, (*location, inner), indent + "  ", origin_of)
        case [*items] if any(isinstance(item, Mapping) and item for item in items):
            yield start, ""
            for index, item in enumerate(items):
                here = (*location, index)
                begin = f"{indent}  - "
                if not isinstance(item, Mapping) or not item:
                    yield f"{begin}{_flow(item)}", origin_of(here)
                    continue
                for inner, field in item.items():
                    for text, origin in _lines(inner, field, (*here, inner), indent + "    ", origin_of):
                        yield begin + text[len(begin) :], origin
                        begin = indent + "    "
        case _:
            yield f"{start} {_flow(value)}", origin_of(location)


def _flow(value: Any) -> str:
    """Return ``value`` as YAML on one line."""
    if isinstance(value, str) and not value.isprintable():
        return json.dumps(value)
    text: str = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True, width=math.inf)
    return text.removesuffix("...\n").strip()


_DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"


class _SchemaGenerator(GenerateJsonSchema):
    """Writes defaults as in YAML, describes keys, and omits their titles, which only repeat the key."""

    def model_schema(self, schema: Any) -> Any:
        generated = super().model_schema(schema)
        for key, text in key_descriptions(schema["cls"]).items():
            generated["properties"][key]["description"] = text
        return generated

    def encode_default(self, dft: Any) -> Any:
        if dft == WIRE_ORDER:
            return [component.key for component in WIRE_ORDER]
        return "all" if isinstance(dft, AllFrames) else super().encode_default(dft)

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ARG002 - no key has one
        return False


def schema_text(model: type[Settings]) -> str:
    """Return the JSON schema of ``model``, the content of ``config/gateway.schema.json``."""
    schema = model.model_json_schema(schema_generator=_SchemaGenerator)
    return json.dumps({"$schema": _DIALECT, **schema, "title": "RTC3D gateway"}, indent=2) + "\n"
