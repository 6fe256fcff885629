"""Events as text: what the server's parameters (§6.6) say about the id and the parameters of an event."""

import struct
from typing import Any, Final, NamedTuple

from gateway.descriptions.labels import event_number
from gateway.rtc3d.parameters import EventDefinition, EventParameter, Parameters

UNUSED: Final = -1
"""An event's parameter that is not used (0xFFFFFFFF)."""

MAX_EVENT_AGE_US: Final = 1_000_000
"""An event's own time stamp is used if it is as near as this to that of its frame."""


class EventText(NamedTuple):
    """What an event is called, and the names and values of its parameters, such as "State" and "ON"."""

    label: str
    values: tuple[tuple[str, str], ...]

    @property
    def description(self) -> str:
        """All parameters, such as "Button id number: 3; ON/OFF state: ON"."""
        return "; ".join(f"{name}: {value}" for name, value in self.values)


def event_text(parameters: Parameters, item: Any) -> EventText:
    """Return the texts of one event, an item with the fields of LONG_EVENT."""
    definition = _definition(parameters, int(item["id"]))
    values = [int(item[name]) for name in ("param1", "param2", "param3")]
    described = definition.parameters if definition else ()
    found = []
    for index, value in enumerate(values):
        if index < len(described):
            name = described[index].description or f"param{index + 1}"
            if value != UNUSED:
                found.append((name, _value(described[index], value)))
        elif value != UNUSED:
            found.append((f"param{index + 1}", str(value)))
    label = definition.label.strip() if definition else ""
    return EventText(label or f"event {int(item['id'])}", tuple(found))


def _definition(parameters: Parameters, number: int) -> EventDefinition | None:
    definitions = parameters.events.events if parameters.events else ()
    return next((found for found in definitions if event_number(found.id) == number), None)


def _value(parameter: EventParameter, value: int) -> str:
    """Return a parameter's value as its type (int, float or 4 characters), or the label that it has."""
    data = struct.pack(">i", value)
    match parameter.type.strip().lower():
        case "float":
            text = f"{struct.unpack('>f', data)[0]:.9g}"
        case "string":
            text = data.decode("latin-1").rstrip("\0 ")
        case _:
            text = str(value)
    labels = {expected.value.strip(): expected.label.strip() for expected in parameter.expected_values}
    return labels.get(text) or text
