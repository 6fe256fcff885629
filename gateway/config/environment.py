"""Environment variables that stand over a configuration file, for containers.

``RTC3D_GATEWAY__LCM__URL`` sets ``lcm.url``, ``RTC3D_GATEWAY__SOURCES__0__HOST`` the first source's
``host``: two underscores go one level down, a number is the index in a list, and the value is YAML, as
it would stand in the file. Names with one underscore after the program's are others': Kubernetes sets
RTC3D_GATEWAY_SERVICE_HOST where a service has that name.
"""

import re
from collections.abc import Mapping
from typing import Any, Final

from gateway.config.secrets import is_secret_key
from gateway.config.section import shown
from gateway.config.yaml_document import Document, Location, Place, is_whole, read_yaml

PREFIX: Final = "RTC3D_GATEWAY__"


def variable_name(location: Location) -> str:
    """Return the name of the variable that sets the value that ``location`` leads to."""
    return PREFIX + "__".join(str(step).upper() for step in location)


def override(document: Document, environ: Mapping[str, str]) -> None:
    """Set in ``document`` what the variables say, each variable as the place of what it sets.

    Raises ConfigError, the variable as its place, for a name that leads nowhere, or a value that is no
    YAML. Whether keys and values are accepted is seen later, as with those of the file.
    """
    if not isinstance(document.values, dict):
        return  # a file of something else, which will be told
    names = [name for name in environ if name.startswith(PREFIX)]
    # A mapping comes before its keys, and list items in order: a variable may add the next one.
    for name in sorted(names, key=lambda name: [step.zfill(9) for step in _steps(name)]):
        _Override(document, name).set(environ[name])


def _steps(name: str) -> list[str]:
    return name.removeprefix(PREFIX).lower().split("__")


def _holds(container: Any, key: Any) -> bool:
    return key in container if isinstance(container, dict) else key < len(container)


class _Override:
    """One variable on its way into the document."""

    def __init__(self, document: Document, name: str) -> None:
        self._document = document
        self._place = Place(name)
        self._steps = _steps(name)

    def set(self, text: str) -> None:
        if not all(self._steps):
            raise self._place.error(
                (), f"names no key; accepted is a name such as {variable_name(('lcm', 'url'))}"
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
                self._put(container, key, Document(new, {(): self._place}, {}), location)
            container = container[key]

    def _key(self, container: object, location: Location, step: str) -> Any:
        """Return ``step`` as the key or index in ``container``, the value that ``location`` leads to."""
        match container:
            case dict():
                return step
            case list():
                if re.fullmatch("[0-9]{1,9}", step) and int(step) <= len(container):
                    return int(step)
                raise self._place.error(
                    location,
                    f"found the index {shown(step)}; accepted is a number from 0 to {len(container)}",
                )
        place = self._document.nearest_place(location)
        raise self._place.error(
            location,
            f"has no keys to set, it is {shown(container)} ({place}); "
            f"accepted is all of it in {variable_name(location)}",
        )

    def _put(self, container: Any, key: Any, read: Document, location: Location) -> None:
        if isinstance(container, list) and not _holds(container, key):
            container.append(read.values)
        else:
            container[key] = read.values
        for all_places, new_places in (
            (self._document.places, read.places),
            (self._document.key_places, {(): self._place, **read.key_places}),
        ):
            for other in [other for other in all_places if other[: len(location)] == location]:
                del all_places[other]
            all_places.update({(*location, *inner): place for inner, place in new_places.items()})

    def _read(self, text: str, location: Location) -> Document:
        """Return the variable's value; a secret is text as it stands, whatever YAML would make of it."""
        if not is_secret_key(location[-1]):
            read = read_yaml(text, self._place.origin, has_lines=False)
            return Document(read.values, {(): self._place, **read.places}, read.key_places)
        if not is_whole(text):
            raise self._place.error(location, "found bytes that are not UTF-8; accepted is text")
        return Document(text, {(): self._place}, {})
