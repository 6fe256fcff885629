"""Read settings from YAML files and environment variables. Every mistake is reported with its position."""

import json
import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from pydantic import ValidationError

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
from gateway.config.section import UNKNOWN_KEY, Section
from gateway.config.settings import OutputSettings, Settings
from gateway.config.words import MASK, file_key_for, find_secrets, is_secret_key, mask_secrets_in_text
from gateway.errors import ConfigError

logger = logging.getLogger(__name__)

_RENAMED: Final = {("metrics", "address"): "host"}
"""The sections and keys of earlier versions that are accepted, with their new names."""

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
    for (section, old), new in _RENAMED.items():
        _rename(document, section, old, new)
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


def _rename(document: Document, section: str, old: str, new: str) -> None:
    """Give a value its new key, and log that. A variable with the old name overrides the file, as others."""
    values = document.values.get(section) if isinstance(document.values, dict) else None
    if not isinstance(values, dict) or old not in values:
        return
    position = document.positions[section, old]
    if new in values and (position.line or not document.positions[section, new].line):
        return  # validation reports the old key as unknown
    logger.warning("%s: %s.%s is now called %s.%s; use the new name", position, section, old, section, new)
    values[new] = values.pop(old)
    document.positions[section, new] = document.positions.pop((section, old))
    if (section, old) in document.key_positions:
        document.key_positions[section, new] = document.key_positions.pop((section, old))


def _read_file(path: Path, section: type[Section], example: str) -> Document:
    document = read_yaml(_text_of(path, example), str(path))
    if not document.positions:
        needed = next(name for name, field in section.model_fields.items() if field.is_required())
        raise ConfigError(f"{path}: empty; expected a mapping with at least the key {needed}")
    return document


def _text_of(path: Path, example: str) -> str:
    try:
        data = read_file(path)
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read: {error.strerror}; name a YAML file such as {example}"
        ) from error
    try:
        return data.decode("utf-8-sig")  # some editors begin a file with a byte order mark
    except UnicodeDecodeError as error:
        position = Position(str(path), *line_and_column_after(error.object[: error.start].decode()))
        found = f"0x{error.object[error.start]:02X}"
        raise position.error((), f"found the byte {found}; expected text in UTF-8") from None


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
        position = document.key_positions.get(location) if details["type"] == UNKNOWN_KEY else None
        position = position or document.nearest_position(location)
        if position.line:
            text += _those_in(variables, location)
        mistakes.append((position, position.error(location, text)))
    return mistakes


def _those_in(variables: list[tuple[Location, str]], location: Location) -> str:
    """Return a hint that names the variables that set parts of the value; one may have the mistake."""
    names = {name for place, name in variables if place[: len(location)] == location}
    return f" (a part of it is from {', '.join(sorted(names))})" if names else ""


def _mask_secrets(document: Document, foreign: Location, safe_place: str) -> list[_Mistake]:
    """Mask the secrets below ``foreign`` that are in the file itself, and return a mistake for each.

    Configuration files are shared and kept under version control, so they must not contain secrets. Masking
    keeps the secrets out of later error messages.
    """
    config = document.values
    for key in foreign:
        config = config.get(key) if isinstance(config, dict) else None
    mistakes = []
    for steps, secret in list(find_secrets(config)):
        location = (*foreign, *steps)
        position = document.nearest_position(location)
        if not position.line:
            continue
        _replace(config, steps, MASK if is_secret_key(steps[-1]) else mask_secrets_in_text(secret))
        path_key = file_key_for(steps[-1])
        others = f"{path_key} with the path of the key's file, " if path_key else ""
        text = (
            f"found a secret, which does not belong in this file; use {others}"
            f"the environment variable {variable_name(location)}, or {safe_place}"
        )
        mistakes.append((position, position.error(location, text)))
    return mistakes


def _replace(config: Any, steps: Location, value: object) -> None:
    *parents, last = steps
    for step in parents:
        config = config[step]
    config[last] = value
