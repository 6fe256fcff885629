"""Environment variables that override the configuration file, for containers.

``RTC3D_GATEWAY__LCM__URL`` sets ``lcm.url``, and ``RTC3D_GATEWAY__SOURCES__0__HOST`` sets ``host`` of the
first source: two underscores separate the levels, a number is an index in a list, and the value is YAML as
in the file. Names with a single underscore after RTC3D_GATEWAY belong to others: Kubernetes sets
RTC3D_GATEWAY_SERVICE_HOST for a service of that name.
"""

import re
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, Final

from gateway.config.secrets import is_secret_key
from gateway.config.section import describe
from gateway.config.yaml_document import Document, Location, Position, is_encodable, read_yaml

VARIABLE_PREFIX: Final = "RTC3D_GATEWAY__"


def variable_name(location: Location) -> str:
    """Return the name of the variable that sets the value at ``location``."""
    return VARIABLE_PREFIX + "__".join(str(step).upper() for step in location)


def apply_overrides(document: Document, environ: Mapping[str, str]) -> None:
    """Write the values of the variables into ``document``, with the variable's name as their position.

    Raises ConfigError, with the variable as its position, if a name leads to no key or a value is not
    YAML. Unknown keys and wrong values are found later, like those of the file.
    """
    if not isinstance(document.values, dict):
        return  # not a mapping, which the validation of the document reports
    names = [name for name in environ if name.startswith(VARIABLE_PREFIX)]
    # Sorted so that mappings come before their keys and list items in order: each may append the next item.
    for name in sorted(names, key=lambda name: [step.zfill(9) for step in _steps(name)]):
        _VariableOverride(document, name).apply(environ[name])


def _steps(name: str) -> list[str]:
    return name.removeprefix(VARIABLE_PREFIX).lower().split("__")


def _contains(container: Any, key: Any) -> bool:
    return key in container if isinstance(container, dict) else key < len(container)


class _VariableOverride:
    """Writes the value of one variable into the document."""

    def __init__(self, document: Document, name: str) -> None:
        self._document = document
        self._position = Position(name)
        self._steps = _steps(name)

    def apply(self, text: str) -> None:
        if not all(self._steps):
            example = variable_name(("lcm", "url"))
            raise self._position.error((), f"names no key; expected a name such as {example}")
        container = self._document.values
        location: Location = ()
        for step, next_step in pairwise([*self._steps, ""]):
            key = self._key(container, location, step)
            location = (*location, key)
            if not next_step:
                self._set(container, key, self._read(text, location), location)
            elif not _contains(container, key):
                empty: Any = [] if re.fullmatch("[0-9]+", next_step) else {}
                self._set(container, key, Document(empty, {(): self._position}, {}), location)
            container = container[key]

    def _key(self, container: object, location: Location, step: str) -> Any:
        """Return ``step`` as a key or index of ``container``, the value at ``location``."""
        match container:
            case dict():
                return step
            case list():
                if re.fullmatch("[0-9]{1,9}", step) and int(step) <= len(container):
                    return int(step)
                expected = f"expected a number from 0 to {len(container)}"
                raise self._position.error(location, f"found the index {describe(step)}; {expected}")
        position = self._document.nearest_position(location)
        raise self._position.error(
            location,
            f"this value has no keys, it is {describe(container)} ({position}); "
            f"set the whole value with {variable_name(location)}",
        )

    def _set(self, container: Any, key: Any, value: Document, location: Location) -> None:
        """Set or append ``container[key]``, which is at ``location``, and the positions in it."""
        if isinstance(container, list) and not _contains(container, key):
            container.append(value.values)
        else:
            container[key] = value.values
        key_positions = {(): self._position, **value.key_positions}
        _replace_positions(self._document.positions, location, value.positions)
        _replace_positions(self._document.key_positions, location, key_positions)

    def _read(self, text: str, location: Location) -> Document:
        """Return the value, read as YAML; a secret is the text itself, which may look like other YAML."""
        if not is_secret_key(location[-1]):
            value = read_yaml(text, self._position.origin, has_lines=False)
            return Document(value.values, {(): self._position, **value.positions}, value.key_positions)
        if not is_encodable(text):
            raise self._position.error(location, "found bytes that are not UTF-8; expected text")
        return Document(text, {(): self._position}, {})


def _replace_positions(
    positions: dict[Location, Position], location: Location, new: Mapping[Location, Position]
) -> None:
    """Replace the positions at and below ``location``; the locations in ``new`` are relative to it."""
    for other in [other for other in positions if other[: len(location)] == location]:
        del positions[other]
    positions.update({(*location, *inner): position for inner, position in new.items()})
