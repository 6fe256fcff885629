"""The types and names of the five components of data frames (§7.2); ``components`` has what is in them.

This module needs no numpy, so that a command line can name the components without loading it.
"""

from enum import IntEnum
from typing import Final


class ComponentType(IntEnum):
    """The component types of §7.2; ``_NAMES`` below has their names."""

    MARKERS = 1
    ANALOG = 2
    FORCE = 3
    TOOLS = 4
    EVENT = 5

    @property
    def key(self) -> str:
        """The name in keys, in channels (upper-case) and in settings: 3d, 6d, analog, force or event."""
        return _NAMES[self][0]

    @property
    def command_word(self) -> str:
        """The name in commands (§5.3.5): 3D, 6D, Analog, Force or Events."""
        return _NAMES[self][1]

    @property
    def item_noun(self) -> str:
        """What the items are called: markers, tools, channels, plates or events."""
        return _NAMES[self][2]


_NAMES: Final = {
    ComponentType.MARKERS: ("3d", "3D", "markers"),
    ComponentType.TOOLS: ("6d", "6D", "tools"),
    ComponentType.ANALOG: ("analog", "Analog", "channels"),
    ComponentType.FORCE: ("force", "Force", "plates"),
    ComponentType.EVENT: ("event", "Events", "events"),
}

WIRE_ORDER: Final = tuple(_NAMES)
"""All components, in the order in which servers put them into a frame (field note 5)."""

COMPONENTS_BY_KEY: Final = {component.key: component for component in WIRE_ORDER}
