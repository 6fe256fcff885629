"""The types and names of the five components of data frames (§7.2); ``components`` has what is in them.

This module needs no numpy, so that a command line can name the components without loading it.
"""

from enum import IntEnum
from typing import Final


class ComponentType(IntEnum):
    """The component types of §7.2, with their names."""

    key: str
    """The name in keys, in channels (upper-case) and in settings."""
    command_word: str
    """The name in commands (§5.3.5)."""
    item_noun: str
    """What the items are called."""

    def __new__(cls, number: int, key: str, command_word: str, item_noun: str) -> "ComponentType":
        """Return the member with this number and these names."""
        member = int.__new__(cls, number)
        member._value_ = number
        member.key, member.command_word, member.item_noun = key, command_word, item_noun
        return member

    MARKERS = 1, "3d", "3D", "markers"
    ANALOG = 2, "analog", "Analog", "channels"
    FORCE = 3, "force", "Force", "plates"
    TOOLS = 4, "6d", "6D", "tools"
    EVENT = 5, "event", "Events", "events"


WIRE_ORDER: Final = (
    ComponentType.MARKERS,
    ComponentType.TOOLS,
    ComponentType.ANALOG,
    ComponentType.FORCE,
    ComponentType.EVENT,
)
"""All components, in the order in which servers put them into a frame (field note 5)."""

COMPONENTS_BY_KEY: Final = {component.key: component for component in WIRE_ORDER}
