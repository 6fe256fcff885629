"""Environment variables that override the configuration file, for containers.

``RTC3D_GATEWAY__LCM__URL`` sets ``lcm.url``, and ``RTC3D_GATEWAY__SOURCES__0__HOST`` sets the ``host`` of
the first source. Two underscores separate levels, and a number is an index in a list. The value is YAML, as
in the file. Variables with a single underscore after RTC3D_GATEWAY are ignored, because Kubernetes sets some:
RTC3D_GATEWAY_SERVICE_HOST, for example, if a service has the name rtc3d-gateway.
"""

import re
from collections.abc import Mapping
from typing import Any, Final

from gateway.config.secrets import is_secret_key
from gateway.config.words import describe
from gateway.config.yaml_document import Document, Location, Position, is_encodable, read_yaml

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
    names = [name for name in environ if name.startswith(VARIABLE_PREFIX)]
    # Sort mappings before their keys, and list items by index, because a variable may append an item.
    for name in sorted(names, key=lambda name: [step.zfill(9) for step in _steps(name)]):
        _Override(document, name).set(environ[name])


def _steps(name: str) -> list[str]:
    return name.removeprefix(VARIABLE_PREFIX).lower().split("__")


def _holds(container: Any, key: Any) -> bool:
    return key in container if isinstance(container, dict) else key < len(container)


class _Override:
    """One variable, to be set in the document."""

    def __init__(self, document: Document, name: str) -> None:
        self._document = document
        self._position = Position(name)
        self._steps = _steps(name)

    def set(self, text: str) -> None:
        if not all(self._steps):
            raise self._position.error(
                (), f"does not name a key; expected a name such as {variable_name(('lcm', 'url'))}"
            )
        container = self._document.values
        location: Location = ()
        for number, step in enumerate(self._steps):
            key = self._key(container, location, step)
            location = (*location, key)
            following = self._steps[number + 1 : number + 2]
            if not following:
                self._put(container, key, self._read(text, location), location)
            elif not _holds(container, key):
                new: Any = [] if re.fullmatch("[0-9]+", following[0]) else {}
                self._put(container, key, Document(new, {(): self._position}, {}), location)
            container = container[key]

    def _key(self, container: object, location: Location, step: str) -> Any:
        """Return ``step`` as a key or index of ``container``, the value at ``location``."""
        match container:
            case dict():
                return step
            case list():
                if re.fullmatch("[0-9]{1,9}", step) and int(step) <= len(container):
                    return int(step)
                raise self._position.error(
                    location,
                    f"found the index {describe(step)}; expected a number from 0 to {len(container)}",
                )
        position = self._document.nearest_position(location)
        raise self._position.error(
            location,
            f"this value is {describe(container)} ({position}), which has no keys; "
            f"set the whole value with {variable_name(location)}",
        )

    def _put(self, container: Any, key: Any, read: Document, location: Location) -> None:
        if isinstance(container, list) and not _holds(container, key):
            container.append(read.values)
        else:
            container[key] = read.values
        for all_positions, new_positions in (
            (self._document.positions, read.positions),
            (self._document.key_positions, {(): self._position, **read.key_positions}),
        ):
            for other in [other for other in all_positions if other[: len(location)] == location]:
                del all_positions[other]
            all_positions.update({(*location, *inner): position for inner, position in new_positions.items()})

    def _read(self, text: str, location: Location) -> Document:
        """Return the value of the variable. A secret is taken literally, not as YAML."""
        if not is_secret_key(location[-1]):
            read = read_yaml(text, self._position.origin, has_lines=False)
            return Document(read.values, {(): self._position, **read.positions}, read.key_positions)
        if not is_encodable(text):
            raise self._position.error(location, "found bytes that are not UTF-8; expected text")
        return Document(text, {(): self._position}, {})
