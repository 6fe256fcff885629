"""What the server's parameters (§6) call the items of a component, their units and rates, and its events."""

import struct
from collections.abc import Callable, Iterable, Sequence
from itertools import islice
from typing import Any, Final, NamedTuple, TypeVar

from gateway.messages.topics import JSON_NAME, MAX_LABEL_LENGTH
from gateway.rtc3d.components import ComponentType, described_labels
from gateway.rtc3d.parameters import EventParameter, Parameters

_Value = TypeVar("_Value")

_MOMENT_CHANNEL: Final = 3
"""The first channel of a plate that is a moment; those before it are forces (§6.5, §7.5)."""


class Description(NamedTuple):
    """What the parameters say about a component with a certain number of items.

    ``labels`` has one different name per item. ``units`` has the unit of each item: for markers and tools
    that of positions, for plates that of forces ("" if the server does not say it). ``moment_unit`` is for
    plates only. ``rate_hz`` is the announced rate of frames; None if it is not announced, or if the items
    have different rates.
    """

    labels: tuple[str, ...]
    units: tuple[str, ...]
    moment_unit: str
    rate_hz: float | None

    @property
    def unit(self) -> str:
        """The unit of all items; "" if they differ."""
        return common(self.units) or ""


def describe(component: ComponentType, parameters: Parameters | None, num_items: int) -> Description:
    """Return the description of a component with ``num_items`` items, in the order of the items.

    An item without a label is called by its position: "marker 1", "tool 1", "channel 1", "plate 1". A label
    that another item has already gets _2, _3, …. The same rules hold for the keys of tools
    (docs/reference/messages.md). Events have no labels: see ``event_labels``.
    """
    parameters = parameters or Parameters()
    labels: Iterable[str] = ()
    units: tuple[str, ...] = ()
    rates: tuple[float | None, ...] = ()
    moment_unit, default_unit = "", ""
    match component:
        case ComponentType.MARKERS | ComponentType.TOOLS:
            default_unit = parameters.length_unit
            labels = described_labels(parameters, component)
            section = parameters.markers if component is ComponentType.MARKERS else parameters.tools
            rates = (section.frequency_hz,) if section else ()
        case ComponentType.ANALOG:
            default_unit = "mV"
            channels = parameters.analog.channels[:num_items] if parameters.analog else ()
            labels = (channel.label for channel in channels)
            units = tuple(channel.unit for channel in channels)
            rates = tuple(channel.frequency_hz for channel in channels)
        case ComponentType.FORCE:
            plates = parameters.force.plates[:num_items] if parameters.force else ()
            labels = (plate.label for plate in plates)
            units = tuple(plate.channels[0].unit if plate.channels else "" for plate in plates)
            rates = tuple(plate.frequency_hz for plate in plates)
            moments = [plate.channels[_MOMENT_CHANNEL:][:1] for plate in plates]
            moment_unit = common(found[0].unit if found else "" for found in moments) or ""
        case ComponentType.EVENT:
            return Description((), (), "", None)
    noun = component.item_noun.removesuffix("s")
    given = [label.strip() for label in islice(labels, num_items)]
    given += [""] * (num_items - len(given))
    found = distinct(
        [(label or f"{noun} {index}")[:MAX_LABEL_LENGTH] for index, label in enumerate(given, start=1)],
        lambda text, length: text[: MAX_LABEL_LENGTH - length],
        [JSON_NAME] if component is ComponentType.TOOLS else [],  # no key of a tool is that of JSON
    )
    units += (default_unit,) * (num_items - len(units))
    return Description(tuple(found), units, moment_unit, common(rates))


def event_labels(parameters: Parameters | None) -> dict[int, str]:
    """Return the labels of the events (§6.6) by their ids; ids that are not numbers are left out."""
    labels: dict[int, str] = {}
    definitions = parameters.events.events if parameters and parameters.events else ()
    for definition in definitions:
        number = event_number(definition.id)
        if number is not None and definition.label.strip():
            labels.setdefault(number, definition.label.strip())
    return labels


def event_number(event_id: str) -> int | None:
    """Return an event's id in the parameters, decimal or 0x…, as in ``event_t``; None if it is no number."""
    try:
        number = int(event_id, 0) if event_id[:2].lower() == "0x" else int(event_id)
    except ValueError:
        return None
    # The id is a signed 32-bit number in event_t, but servers write 0xFFFFFFFF.
    return number - (1 << 32) if 1 << 31 <= number < 1 << 32 else number


def common(values: Iterable[_Value]) -> _Value | None:
    """Return the value that all ``values`` have; None if they differ, or if there are none."""
    different = set(values)
    return different.pop() if len(different) == 1 else None


def fitting_labels(
    labels: Sequence[str], fit: Callable[[str], str], max_bytes: int, noun: str
) -> tuple[str, ...]:
    """Return labels after ``fit``, of at most ``max_bytes`` in UTF-8 and each different.

    An empty one is called by its position, such as "marker 3". One that another item has already gets _2,
    _3, ….
    """
    bases = (
        cut(fit(label), max_bytes) or fit(f"{noun} {position}")
        for position, label in enumerate(labels, start=1)
    )
    return tuple(distinct(bases, lambda text, num_bytes: cut(text, max_bytes - num_bytes)))


def distinct(
    bases: Iterable[str], shorten: Callable[[str, int], str], taken: Sequence[str] = ()
) -> list[str]:
    """Return labels that differ from each other and from ``taken``.

    ``shorten`` makes room in a label for a suffix of this length.
    """
    names = dict.fromkeys(taken)
    numbers: dict[str, int] = {}  # tried last, by label; many items may have the same label
    for base in bases:
        name, number = base, numbers.get(base, 1)
        while name in names:
            number += 1
            suffix = f"_{number}"
            name = shorten(base, len(suffix)) + suffix
        numbers[base] = number
        names[name] = None
    return list(names)[len(taken) :]


def printable(text: str) -> str:
    """Return a text with "_" in place of each character that is not printable."""
    return "".join(character if character.isprintable() else "_" for character in text).strip()


def cut(text: str, max_bytes: int) -> str:
    """Return a text of at most ``max_bytes`` in UTF-8, cut between two characters."""
    return text.encode(errors="replace")[:max_bytes].decode(errors="ignore").strip()


UNUSED: Final = -1
"""An event's parameter that is not used (0xFFFFFFFF)."""

EVENT_VALUES: Final = ("id", "param1", "param2", "param3")
"""The fields of an event that its text is made of."""

MAX_EVENT_AGE_US: Final = 1_000_000
"""An event's own time stamp is used if it is as near as this to that of its frame."""


def event_time_us(frame_us: int, timestamp_us: int, event_us: int) -> int:
    """Return when an event happened, in µs on the clock of ``frame_us``, the time of its frame.

    ``timestamp_us`` and ``event_us`` are the server's time stamps of the frame and of the event, which may be
    earlier or later (field note 6). If it is implausible, the event has the time of the frame.
    """
    delay_us = event_us - timestamp_us
    return frame_us + delay_us if abs(delay_us) <= MAX_EVENT_AGE_US else frame_us


class EventText(NamedTuple):
    """What an event is called, and the names and values of its parameters, such as "State" and "ON"."""

    label: str
    values: tuple[tuple[str, str], ...]

    @property
    def description(self) -> str:
        """All parameters, such as "Button id number: 3; ON/OFF state: ON"."""
        return "; ".join(f"{name}: {value}" for name, value in self.values)


def given_labels(component: ComponentType, parameters: Parameters) -> list[str]:
    """Return the labels of the items as the server gave them, which may be empty or equal."""
    match component:
        case ComponentType.ANALOG:
            return [channel.label for channel in parameters.analog.channels] if parameters.analog else []
        case ComponentType.FORCE:
            return [plate.label for plate in parameters.force.plates] if parameters.force else []
    return described_labels(parameters, component)


def event_text(parameters: Parameters, item: Any) -> EventText:
    """Return the texts of one event, an item with the fields of LONG_EVENT."""
    number = int(item["id"])
    definitions = parameters.events.events if parameters.events else ()
    definition = next((found for found in definitions if event_number(found.id) == number), None)
    described = definition.parameters if definition else ()
    found = []
    for index, name in enumerate(("param1", "param2", "param3")):
        value = int(item[name])
        if value != UNUSED and index < len(described):
            found.append((described[index].description or name, _value(described[index], value)))
        elif value != UNUSED:
            found.append((name, str(value)))
    label = definition.label.strip() if definition else ""
    return EventText(label or f"event {number}", tuple(found))


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
