"""The trackers of all sources: their names and numbers."""

import re
from collections.abc import Mapping, Sequence
from typing import Final, Literal, NamedTuple

from gateway.outputs.adapters.vrpn.protocol import MAX_NAME_BYTES

TrackerNames = Literal["auto", "tool", "source/tool"]
"""How trackers are named: by tool, by source and tool, or (auto) by tool if there is only one source."""

MAX_TRACKERS: Final = 1000
"""How many trackers there can be, over all sources. libvrpn's clients have room for 2000 names.

The servers determine how many tools there are and how often they are renamed.
"""

_NOT_IN_NAMES: Final = re.compile(r"[^\w.-]")  # VRPN's users write NAME@HOST, in files separated by spaces


class Tracker(NamedTuple):
    """One tool as a VRPN device."""

    number: int
    name: str


class _Key(NamedTuple):
    """What a tracker belongs to. ``has_prefix`` is whether the name begins with the source's."""

    source: str
    tool: str
    has_prefix: bool


class Trackers:
    """Gives the tools of each source trackers.

    A tool keeps its tracker's name and number while it comes and goes. Only when MAX_TRACKERS are used up, a
    former tool's number is used for another one. ``version`` grows with every change of ``by_name``.
    """

    def __init__(self, names: TrackerNames) -> None:
        self.version = 0
        self._names = names
        self._tools: dict[str, Sequence[str]] = {}  # of each source
        self._by_key: dict[_Key, Tracker] = {}  # the most recently given ones are last
        self._of_source: dict[str, dict[str, Tracker | None]] = {}
        self.by_name: dict[str, Tracker] = {}
        """The trackers of the tools that there are now."""

    def of_source(self, source: str) -> Mapping[str, Tracker | None]:
        """Return the trackers of a source by the tools' names, in their order; None for one too many.

        Any thread may ask.
        """
        return self._of_source.get(source, {})

    def set_tools(self, source: str, tools: Sequence[str]) -> None:
        """Set the names of a source's tools, which are all different. A source without tools is one, too."""
        if self._tools.get(source) != tools:
            self._tools[source] = tools
            self._update()

    def remove(self, source: str) -> None:
        """Forget a source."""
        if self._tools.pop(source, None) is not None:
            self._by_key = {key: tracker for key, tracker in self._by_key.items() if key.source != source}
            self._update()

    def _update(self) -> None:
        has_prefix = self._names == "source/tool" or (self._names == "auto" and len(self._tools) > 1)
        keys = {
            source: [_Key(source, tool, has_prefix) for tool in tools]
            for source, tools in self._tools.items()
        }
        in_use = {key for of_source in keys.values() for key in of_source}
        for key in in_use & self._by_key.keys():
            self._by_key[key] = self._by_key.pop(key)
        new_keys = [key for of_source in keys.values() for key in of_source if key not in self._by_key]
        # Forget as many former tools as necessary, those first that have been away for the longest time.
        former = [key for key in self._by_key if key not in in_use]
        for key in former[: max(0, len(self._by_key) + len(new_keys) - MAX_TRACKERS)]:
            del self._by_key[key]
        self._add(new_keys[: MAX_TRACKERS - len(self._by_key)])
        self._of_source = {
            source: {key.tool: self._by_key.get(key) for key in of_source}
            for source, of_source in keys.items()
        }
        self.by_name = {
            tracker.name: tracker
            for of_source in self._of_source.values()
            for tracker in of_source.values()
            if tracker is not None
        }
        self.version += 1

    def _add(self, keys: Sequence[_Key]) -> None:
        names = {tracker.name for tracker in self._by_key.values()}
        used = {tracker.number for tracker in self._by_key.values()}
        free = (number for number in range(MAX_TRACKERS) if number not in used)
        for key, number in zip(keys, free, strict=False):
            name = self._new_name(key, names)
            names.add(name)
            self._by_key[key] = Tracker(number, name)

    def _new_name(self, key: _Key, taken: set[str]) -> str:
        """Return a name that is not taken: two tools may have the same name, or nearly the same."""
        name = _NOT_IN_NAMES.sub("_", key.tool)
        if key.has_prefix or (_cut(name) in taken and len(self._tools) > 1):
            name = f"{key.source}/{name}"
        free_name, number = _cut(name), 1
        while free_name in taken:
            number += 1
            free_name = _cut(name, f"_{number}")
        return free_name


def _cut(name: str, ending: str = "") -> str:
    room = MAX_NAME_BYTES - len(ending)
    return name.encode(errors="replace")[:room].decode(errors="ignore") + ending
