"""The analog and force channels that can be plotted, and their samples."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from gateway.live.component import LiveComponent
from gateway.live.live_data import LiveSource
from gateway.rtc3d.components import ITEM_DTYPES, ComponentType
from gateway.safe_text import safe_text
from gateway.takes.component_rows import Array

MAX_CHOICES: Final = 1000
"""How many channels can be chosen from."""

_MAX_LABEL_CHARACTERS: Final = 32

_KEYS: Final = (ComponentType.ANALOG.key, ComponentType.FORCE.key)
_FIELDS: Final = ITEM_DTYPES[ComponentType.FORCE].names or ()


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel of a source: an analog channel, or one field of a force plate.

    ``position`` is that of the channel or the plate, ``field`` is "" for analog channels.
    """

    source: str
    key: str
    position: int
    field: str


def choices(sources: Sequence[LiveSource]) -> dict[str, Channel]:
    """Return the channels that can be plotted, at most MAX_CHOICES, by what they are called."""
    found: dict[str, Channel] = {}
    for source in sources:
        for channel, text in _channels(source):
            if len(found) == MAX_CHOICES:
                return found
            found[text] = channel
    return found


def first_choice(offered: Mapping[str, Channel]) -> str | None:
    """Return what most people look at first: the vertical force on a plate, otherwise the first channel."""
    return next(
        (text for text, channel in offered.items() if channel.field == "fz"), next(iter(offered), None)
    )


def _channels(source: LiveSource) -> Iterator[tuple[Channel, str]]:
    for key in _KEYS:
        component = source.components.get(key)
        if component is None:
            continue
        description = component.description
        labels, units = (map(_cut, texts[:MAX_CHOICES]) for texts in (description.labels, description.units))
        moment_unit = _cut(description.moment_unit)
        for position, (label, unit) in enumerate(zip(labels, units, strict=True)):
            # Labels that are cut may be equal; the number distinguishes them.
            name = f"{_cut(source.name)} {key} {position + 1}: {label}"
            for field in _FIELDS if key == ComponentType.FORCE.key else ("",):
                of_field = moment_unit if field.startswith("m") else unit
                words = [name, field.capitalize(), f"({of_field})" if of_field else ""]
                yield Channel(source.name, key, position, field), " ".join(filter(None, words))


def _cut(text: str) -> str:
    return safe_text(text, _MAX_LABEL_CHARACTERS)


def component_of(channel: Channel, sources: Mapping[str, LiveSource]) -> LiveComponent | None:
    """Return the component that has a channel; None if there is none."""
    source = sources.get(channel.source)
    return None if source is None else source.components.get(channel.key)


def samples(channel: Channel, component: LiveComponent) -> Iterator[tuple[Array, Array]]:
    """Return the samples of a channel in the component's batch: times and values.

    Times are those of capture, in µs since the Unix epoch on the gateway's clock.
    """
    batch = component.batch
    for num_items, items in batch.items.items():
        if channel.position >= num_items:
            continue
        utimes = batch.heads["capture_utime"]
        if len(batch.items) > 1:
            utimes = utimes[batch.heads["num_items"] == num_items]
        values = items[:, channel.position]
        yield utimes, values[channel.field] if channel.field else values
