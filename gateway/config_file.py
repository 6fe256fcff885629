"""Reads a configuration file: YAML to settings, and each mistake with its file, line and column."""

import re
from pathlib import Path
from typing import Any, Final

import yaml
from pydantic import ValidationError

from gateway.config import Settings
from gateway.config_section import UNKNOWN_KEY, shown
from gateway.errors import ConfigError

MAX_FILE_BYTES: Final = 1024 * 1024

MAX_VALUES: Final = 10_000
"""How many values a file may hold; what an alias repeats counts again."""

MAX_DEPTH: Final = 32
"""How many levels of values may be nested."""

MAX_NUMBER_LENGTH: Final = 40
"""How many characters a number may have."""

Location = tuple[str | int, ...]
"""The keys and indices that lead to a value: ("sources", 0, "port")."""

_YAML: Final = "tag:yaml.org,2002:"


def load(path: Path) -> Settings:
    """Return the settings in the YAML file at ``path``; relative paths in it count from its folder.

    Raises ConfigError with one line per mistake, ``FILE:LINE:COLUMN: KEY: what was found; what is
    accepted``. Of mistakes in the YAML itself only the first is told: the rest cannot be read.
    """
    document = _Document(path)
    values = document.read(_text_of(path))
    try:
        return Settings.model_validate(values, context={"folder": path.parent.absolute()})
    except ValidationError as error:
        raise document.explained(error) from None


def _text_of(path: Path) -> str:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read: {error.strerror}; name a YAML file such as config/gateway.yaml"
        ) from error
    if len(data) > MAX_FILE_BYTES:
        raise ConfigError(f"{path}: too large; accepted is a file of at most {MAX_FILE_BYTES} bytes")
    try:
        return data.decode("utf-8-sig")  # some editors begin a file with a byte order mark
    except UnicodeDecodeError as error:
        place = _place_after(error.object[: error.start].decode())
        found = f"0x{error.object[error.start]:02X}"
        raise ConfigError(f"{path}:{place}: found the byte {found}; accepted is text in UTF-8") from None


class _Loader(yaml.SafeLoader):
    """Makes nodes as SafeLoader does, nested to MAX_DEPTH only: it recurses, and Python's stack ends."""

    _depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            mark = parent.start_mark if parent else None
            raise yaml.composer.ComposerError(None, None, f"found more than {MAX_DEPTH} levels", mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


class _Document:
    """The values of a file's one YAML document, and the place of each."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._places: dict[Location, yaml.Mark] = {}
        self._key_places: dict[Location, yaml.Mark] = {}
        self._values_left = MAX_VALUES

    def read(self, text: str) -> object:
        """Return mappings (their keys as text), lists, texts, numbers, truth values and None."""
        try:
            loader = _Loader(text)
        except yaml.reader.ReaderError as error:
            place = _place_after(text[: error.position])
            found = f"the character U+{ord(text[error.position]):04X}"
            raise ConfigError(f"{self._path}:{place}: found {found}, which YAML does not allow") from None
        try:
            root = loader.get_single_node()
        except yaml.MarkedYAMLError as error:
            raise self._not_yaml(error, loader.get_mark()) from None
        except (ValueError, OverflowError):  # from chr() and int() within PyYAML
            raise self._error(loader.get_mark(), (), "not YAML: a number here is out of range") from None
        if root is None:
            raise ConfigError(f"{self._path}: empty; accepted is a mapping, with the key sources at least")
        return self._value(root, ())

    def explained(self, error: ValidationError) -> ConfigError:
        """Return the mistakes that the models found, each with its place, in the file's order."""
        lines = []
        for details in error.errors(include_url=False):
            location = details["loc"]
            mark = self._key_places.get(location) if details["type"] == UNKNOWN_KEY else None
            mark = mark or self._nearest_place(location)
            lines.append((mark.index, str(self._error(mark, location, details["msg"]))))
        return ConfigError("\n".join(line for _, line in sorted(lines)))

    def _nearest_place(self, location: Location) -> yaml.Mark:
        """Return where the value is; where it would belong if it is missing or a default."""
        while location not in self._places:
            location = location[:-1]
        return self._places[location]

    def _value(self, node: yaml.Node, location: Location) -> object:
        self._values_left -= 1
        if self._values_left < 0 or len(location) >= MAX_DEPTH:  # only aliases reach this depth
            limits = f"at most {MAX_VALUES} values in {MAX_DEPTH} levels, those of aliases included"
            raise self._error(node.start_mark, (), f"found too much; accepted are {limits}")
        self._places[location] = node.start_mark
        match node, node.tag.removeprefix(_YAML):
            case yaml.MappingNode(), "map":
                return self._mapping(node, location)
            case yaml.SequenceNode(), "seq":
                return [self._value(item, (*location, index)) for index, item in enumerate(node.value)]
            case (
                yaml.ScalarNode(),
                "str" | "timestamp" | "value" | "merge",
            ):  # a source may be named 2026-06-01
                return self._text(node, location)
            case yaml.ScalarNode(), "bool" | "int" | "float":
                return self._number(node, location)
            case yaml.ScalarNode(), "null":
                return None
        text = f"found the tag {shown(node.tag)}; accepted are values without a tag"
        raise self._error(node.start_mark, location, text)

    def _mapping(self, node: yaml.MappingNode, location: Location) -> dict[str, object]:
        values: dict[str, object] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise self._error(key_node.start_mark, location, "found a list or mapping as a key")
            key = self._text(key_node, location)
            here = (*location, key)
            if key in values:
                first = self._key_places[here].line + 1
                raise self._error(key_node.start_mark, here, f"the same key as in line {first}")
            if key_node.tag == f"{_YAML}merge":
                text = "mappings are not merged; accepted is an alias as a key's value"
                raise self._error(key_node.start_mark, here, text)
            self._key_places[here] = key_node.start_mark
            values[key] = self._value(value_node, here)
        return values

    def _number(self, node: yaml.ScalarNode, location: Location) -> object:
        if len(node.value) <= MAX_NUMBER_LENGTH:
            try:
                return yaml.constructor.SafeConstructor().construct_object(node)
            except (ValueError, LookupError):  # such as 0x_, or a text that is tagged !!int or !!bool
                pass
        text = f"found {shown(node.value)}; accepted is a number of at most {MAX_NUMBER_LENGTH} characters"
        raise self._error(node.start_mark, location, text)

    def _text(self, node: yaml.ScalarNode, location: Location) -> str:
        """Return a key or a text; half a surrogate pair, which an escape can write, is none."""
        try:
            node.value.encode()
        except UnicodeEncodeError:
            found = shown(node.value)
            raise self._error(
                node.start_mark, location, f"found {found}; accepted is text of whole characters"
            ) from None
        text: str = node.value
        return text

    def _not_yaml(self, error: yaml.MarkedYAMLError, end: yaml.Mark) -> ConfigError:
        text = f"not YAML: {error.problem}"
        if error.context and error.context_mark:
            text = f"not YAML: {error.context} from line {error.context_mark.line + 1}: {error.problem}"
        if isinstance(error, yaml.scanner.ScannerError | yaml.parser.ParserError):
            text += "; check indentation, colons, quotes and brackets here"
        return self._error(error.problem_mark or end, (), text)

    def _error(self, mark: yaml.Mark, location: Location, text: str) -> ConfigError:
        key = _key_path(location)
        return ConfigError(
            f"{self._path}:{mark.line + 1}:{mark.column + 1}: {key}{': ' if key else ''}{text}"
        )


def _key_path(location: Location) -> str:
    """Return sources[0].port for ("sources", 0, "port")."""
    path = ""
    for step in location:
        if isinstance(step, int):
            path += f"[{step}]"
        else:
            path += ("." if path else "") + (step if re.fullmatch(r"[\w/-]{1,60}", step) else shown(step))
    return path


def _place_after(text: str) -> str:
    """Return LINE:COLUMN, both from 1, of what follows ``text``."""
    lines = text.split("\n")
    return f"{len(lines)}:{len(lines[-1]) + 1}"
