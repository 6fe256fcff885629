"""A configuration as plain values with their positions: YAML text, and variables that override it.

Errors and ``config show`` use the positions.

Environment variables are for containers. ``RTC3D_GATEWAY__LCM__URL`` sets ``lcm.url``, and
``RTC3D_GATEWAY__SOURCES__0__HOST`` sets the ``host`` of the first source. Two underscores separate levels,
and a number is an index in a list. The value is YAML, as in the file. Variables with a single underscore
after RTC3D_GATEWAY are ignored, because Kubernetes sets some: RTC3D_GATEWAY_SERVICE_HOST, for example, if a
service has the name rtc3d-gateway.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any, Final, NamedTuple

import yaml

from gateway.config.words import describe, is_secret_key
from gateway.errors import ConfigError

MAX_VALUES: Final = 5_000
"""The maximum number of values in a text. Values that an alias repeats count again."""

MAX_DEPTH: Final = 32
"""The maximum number of nested levels."""

MAX_NUMBER_LENGTH: Final = 40
"""The maximum number of characters in a number."""

Location = tuple[str | int, ...]
"""The keys and indices that lead to a value, such as ("sources", 0, "port")."""

_YAML: Final = "tag:yaml.org,2002:"


class Position(NamedTuple):
    """The position of a key or value in a file, or the name of an environment variable.

    ``origin`` is the path of the file or the name of the variable. ``line`` and ``column`` count from 1. Both
    are 0 for variables.
    """

    origin: str
    line: int = 0
    column: int = 0

    def __str__(self) -> str:
        return f"{self.origin}:{self.line}:{self.column}" if self.line else self.origin

    @property
    def without_column(self) -> str:
        """FILE:LINE, or the variable's name."""
        return f"{self.origin}:{self.line}" if self.line else self.origin

    def error(self, location: Location, text: str) -> ConfigError:
        """Return an error with this position, the key at ``location``, and ``text``."""
        key = key_path(location)
        return ConfigError(f"{self}: {key}{': ' if key else ''}{text}")


class _Loader(yaml.SafeLoader):
    """A SafeLoader that limits nesting to MAX_DEPTH and nodes to what MAX_VALUES values and their keys need.

    Deep recursion would overflow the stack. PyYAML takes 10 s for a MiB of very short values.
    """

    _depth = 0
    _nodes = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        self._depth += 1
        self._nodes += 1
        if self._depth > MAX_DEPTH or self._nodes > 2 * MAX_VALUES:
            limit = f"{MAX_DEPTH} levels" if self._depth > MAX_DEPTH else f"{MAX_VALUES} values"
            mark = parent.start_mark if parent else None
            raise yaml.composer.ComposerError(None, None, f"found more than {limit}", mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


@dataclass(frozen=True, slots=True)
class Document:
    """The values of one YAML document, and the position of each value and key. All keys are text."""

    values: Any
    positions: dict[Location, Position]
    key_positions: dict[Location, Position]

    def nearest_position(self, location: Location) -> Position:
        """Return the position of the value, or of the nearest mapping or list around it if it is missing."""
        while location not in self.positions:
            location = location[:-1]
        return self.positions[location]


def read_yaml(text: str, origin: str, *, has_lines: bool = True) -> Document:
    """Return the document in ``text``. An empty document has the value None and no positions.

    Raises ConfigError with the position of the first mistake. Positions consist of ``origin``, line and
    column, or of ``origin`` alone if ``has_lines`` is false.
    """
    reader = _Reader(origin, has_lines)
    try:
        loader = _Loader(text)
    except yaml.reader.ReaderError as error:
        position = reader.position(*line_and_column_after(text[: error.position]))
        found = f"the character U+{ord(text[error.position]):04X}"
        raise position.error((), f"found {found}, which YAML does not allow") from None
    try:
        root = loader.get_single_node()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or loader.get_mark()
        if wrong := _wrong_space(text, mark.line):
            raise reader.position(*wrong.place).error((), wrong.text) from None
        if error.problem in _INDENTATION:
            raise reader.position_of(mark).error((), INDENTATION_TEXT) from None
        problem = f"not YAML: {error.problem}"
        if error.context and error.context_mark:
            problem = f"not YAML: {error.context} from line {error.context_mark.line + 1}: {error.problem}"
        if isinstance(error, yaml.scanner.ScannerError | yaml.parser.ParserError):
            problem += "; check indentation, colons, quotes and brackets here"
        raise reader.position_of(mark).error((), problem) from None
    except (ValueError, OverflowError):  # raised by chr() and int() in PyYAML
        position = reader.position_of(loader.get_mark())
        raise position.error((), "not YAML: a number here is out of range") from None
    values = None if root is None else reader.value(root, ())
    return Document(values, reader.positions, reader.key_positions)


_INDENTATION: Final = frozenset(
    {
        "mapping values are not allowed here",
        "could not find expected ':'",
        "expected <block end>, but found '<block mapping start>'",
        "expected <block end>, but found '<block sequence start>'",
        "expected <block end>, but found '<scalar>'",
        "expected <block end>, but found '-'",
        "expected <block end>, but found '?'",
        "expected '<document start>', but found '<block mapping start>'",
        "sequence entries are not allowed here",
    }
)
"""What PyYAML says where a line begins in the wrong column, or lacks a colon."""

INDENTATION_TEXT: Final = (
    "this line does not fit those above it: keys that belong together begin in the same column, those below "
    "a key two columns further right, and each has a colon and a space; quote a text that contains ': '"
)

_LOOKS_LIKE_SPACE: Final = re.compile("[\t\u00a0\u1680\u2000-\u200b\u202f\u205f\u3000\ufeff]")
_QUOTED_OR_COMMENT: Final = re.compile(r'"(?:\\.|[^"\\])*"|\'[^\']*\'|(?<=\S)\s+#.*|(?<!\S)#.*')


class _WrongSpace(NamedTuple):
    """A character that looks like a space and is none: line and column, and what to do."""

    place: tuple[int, int]
    text: str


def _wrong_space(text: str, line: int) -> _WrongSpace | None:
    """Return the first such character in a line, counted from 0, or in the one before it."""
    lines = re.split("\r\n|[\r\n]", text)
    for number in (line - 1, line):
        if 0 <= number < len(lines):
            bare = _QUOTED_OR_COMMENT.sub(lambda found: "x" * len(found[0]), lines[number])
            if found := _LOOKS_LIKE_SPACE.search(bare):
                name = "a tab" if found[0] == "\t" else f"the character U+{ord(found[0]):04X}"
                what = f"found {name}, which looks like spaces; replace it with spaces"
                return _WrongSpace((number + 1, found.start() + 1), what)
    return None


class _Reader:
    """Makes values of nodes: mappings, lists, text, numbers, booleans and None."""

    def __init__(self, origin: str, has_lines: bool) -> None:
        self._origin = origin
        self._has_lines = has_lines
        self.positions: dict[Location, Position] = {}
        self.key_positions: dict[Location, Position] = {}
        self._values_left = MAX_VALUES

    def value(self, node: yaml.Node, location: Location) -> object:
        position = self.position_of(node.start_mark)
        self._values_left -= 1
        if self._values_left < 0 or len(location) >= MAX_DEPTH:  # only aliases reach this depth
            limits = f"more than {MAX_VALUES} values or {MAX_DEPTH} levels"
            raise position.error((), f"{limits}, counting those that aliases repeat")
        self.positions[location] = position
        match node, node.tag.removeprefix(_YAML):
            case yaml.MappingNode(), "map":
                return self._mapping(node, location)
            case yaml.SequenceNode(), "seq":
                return [self.value(item, (*location, index)) for index, item in enumerate(node.value)]
            # A timestamp is text, because a source may be named 2026-06-01.
            case yaml.ScalarNode(), "str" | "timestamp" | "value" | "merge":
                return self._text(node, location)
            case yaml.ScalarNode(), "bool" | "int" | "float":
                return self._number(node, location)
            case yaml.ScalarNode(), "null":
                return None
        raise position.error(location, f"found the tag {describe(node.tag)}; expected a value without a tag")

    def _mapping(self, node: yaml.MappingNode, location: Location) -> dict[str, object]:
        values: dict[str, object] = {}
        for key_node, value_node in node.value:
            position = self.position_of(key_node.start_mark)
            if not isinstance(key_node, yaml.ScalarNode):
                raise position.error(location, "found a list or mapping as a key")
            key = self._text(key_node, location)
            here = (*location, key)
            if found := _LOOKS_LIKE_SPACE.search(key):
                text = f"found the character U+{ord(found[0]):04X} in a key; it looks like a space: delete it"
                raise position.error(location, text)
            if key in values:
                raise position.error(here, f"the same key as in line {self.key_positions[here].line}")
            if key_node.tag == f"{_YAML}merge":
                raise position.error(here, "merge keys are not supported; use an alias as the value of a key")
            self.key_positions[here] = position
            values[key] = self.value(value_node, here)
        return values

    def _number(self, node: yaml.ScalarNode, location: Location) -> object:
        if len(node.value) <= MAX_NUMBER_LENGTH:
            try:
                return yaml.constructor.SafeConstructor().construct_object(node)
            except (ValueError, LookupError):  # such as 0x_, or text with the tag !!int or !!bool
                pass
        text = f"found {describe(node.value)}; expected a number of at most {MAX_NUMBER_LENGTH} characters"
        raise self.position_of(node.start_mark).error(location, text)

    def _text(self, node: yaml.ScalarNode, location: Location) -> str:
        """Return a key or text. Raises ConfigError for half a surrogate pair, which an escape can produce."""
        text: str = node.value
        if not is_encodable(text):
            found = f"found {describe(text)}; expected text that UTF-8 can encode"
            raise self.position_of(node.start_mark).error(location, found)
        return text

    def position_of(self, mark: yaml.Mark) -> Position:
        return self.position(mark.line + 1, mark.column + 1)

    def position(self, line: int, column: int) -> Position:
        return Position(self._origin, line, column) if self._has_lines else Position(self._origin)


def is_encodable(text: str) -> bool:
    """Return whether UTF-8 can encode ``text``. It cannot encode half a surrogate pair."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def key_path(location: Location) -> str:
    """Return sources[0].port for ("sources", 0, "port")."""
    path = ""
    for step in location:
        if isinstance(step, int):
            path += f"[{step}]"
        else:
            path += ("." if path else "") + (step if re.fullmatch(r"[\w/-]{1,60}", step) else describe(step))
    return path


def line_and_column_after(text: str) -> tuple[int, int]:
    """Return the line and column directly after ``text``, both counted from 1."""
    lines = text.split("\n")
    return len(lines), len(lines[-1]) + 1


VARIABLE_PREFIX: Final = "RTC3D_GATEWAY__"


def variable_name(location: Location) -> str:
    """Return the name of the variable that sets the value at ``location``."""
    return VARIABLE_PREFIX + "__".join(str(step).upper() for step in location)


def apply_overrides(document: Document, environ: Mapping[str, str]) -> None:
    """Set the values of the variables in ``document``, with the variable's name as their position.

    Raises ConfigError with the variable's name if the name does not lead to a place for a value, or if the
    value is not valid YAML. Unknown keys and invalid values are found later, together with those of the file.
    """
    if not isinstance(document.values, dict):
        return  # validation reports that the file does not hold a mapping
    steps = {
        name: name.removeprefix(VARIABLE_PREFIX).lower().split("__")
        for name in environ
        if name.startswith(VARIABLE_PREFIX)
    }
    # Sort mappings before their keys, and list items by index, because a variable may append an item.
    for name in sorted(steps, key=lambda name: [step.zfill(9) for step in steps[name]]):
        _override(document, Position(name), steps[name], environ[name])


def _override(document: Document, variable: Position, steps: list[str], text: str) -> None:
    """Set the value at the end of ``steps``, and the mappings and lists on the way that do not exist."""
    if not all(steps):
        example = variable_name(("lcm", "url"))
        raise variable.error((), f"does not name a key; expected a name such as {example}")
    container = document.values
    location: Location = ()
    for step, following in zip_longest(steps, steps[1:]):
        key: Any = step
        if isinstance(container, list):
            if not re.fullmatch("[0-9]{1,9}", step) or int(step) > len(container):
                found = f"found the index {describe(step)}; expected a number from 0 to {len(container)}"
                raise variable.error(location, found)
            key = int(step)
        elif not isinstance(container, dict):
            raise variable.error(
                location,
                f"this value is {describe(container)} ({document.nearest_position(location)}), which has no "
                f"keys; set the whole value with {variable_name(location)}",
            )
        location = (*location, key)
        if following is None:
            _put(document, container, location, _read_variable(text, location, variable))
        elif key not in container if isinstance(container, dict) else key == len(container):
            new: Any = [] if re.fullmatch("[0-9]+", following) else {}
            _put(document, container, location, Document(new, {(): variable}, {}))
        container = container[key]


def _put(document: Document, container: Any, location: Location, read: Document) -> None:
    """Set or append what was read of a variable, with its positions."""
    key: Any = location[-1]
    if isinstance(container, list) and key == len(container):
        container.append(read.values)
    else:
        container[key] = read.values
    for all_positions, new_positions in (
        (document.positions, read.positions),
        (document.key_positions, {(): read.positions[()], **read.key_positions}),
    ):
        for other in [other for other in all_positions if other[: len(location)] == location]:
            del all_positions[other]
        all_positions.update({(*location, *inner): position for inner, position in new_positions.items()})


def _read_variable(text: str, location: Location, variable: Position) -> Document:
    """Return the value of the variable. A secret is taken literally, not as YAML."""
    if not is_secret_key(location[-1]):
        read = read_yaml(text, variable.origin, has_lines=False)
        return Document(read.values, {(): variable, **read.positions}, read.key_positions)
    if not is_encodable(text):
        raise variable.error(location, "found bytes that are not UTF-8; expected text")
    return Document(text, {(): variable}, {})
