"""The parameters (§6) of a take: as recorded, or derived from its components."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Final

from gateway.errors import ParametersError
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.parameters import (
    SECTIONS,
    AnalogChannel,
    EventDefinition,
    Marker,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersEvents,
    ParametersForce,
    Plate,
    Tool,
    only_sections,
)
from gateway.rtc3d.parameters_xml import encode_parameters, extract_sections, parse_parameters
from gateway.rtc3d.server_description import described_rate_hz, num_described_items

_MAX_EVENT_KINDS: Final = 1000


class RecordedParameters:
    """The parameters of a server while they do not change. ``xml`` is its own text."""

    def __init__(self, xml: bytes) -> None:
        self.xml = xml

    @cached_property
    def parsed(self) -> Parameters:
        """The content of the XML; empty if it cannot be read."""
        try:
            return parse_parameters(self.xml).parameters
        except ParametersError:
            return Parameters()

    @cached_property
    def rates_hz(self) -> Mapping[ComponentType, float]:
        """The rates that the server announces for the components that it has items of."""
        return {
            component: rate_hz
            for component in WIRE_ORDER
            if num_described_items(self.parsed, component)
            and (rate_hz := described_rate_hz(self.parsed, component)) is not None
        }

    def xml_of(self, sections: Collection[str]) -> bytes:
        """Return the XML of some sections (keys of SECTIONS); for all, it is the server's own, unchanged."""
        if not sections or SECTIONS.keys() <= set(sections):
            return self.xml
        extracted = extract_sections(self.xml, sections)
        return encode_parameters(only_sections(self.parsed, sections)) if extracted is None else extracted


def derived_parameters(
    num_items: Mapping[ComponentType, int],
    rates_hz: Mapping[ComponentType, float],
    event_ids: Iterable[int],
) -> RecordedParameters:
    """Return minimal parameters: numbered items, and rates rounded to 0.01 Hz."""

    def ids(component: ComponentType) -> Sequence[str]:
        return [str(number) for number in range(1, num_items.get(component, 0) + 1)]

    def rate_hz(component: ComponentType) -> float | None:
        rate = rates_hz.get(component)
        return None if rate is None else round(rate, 2)

    analog_hz, force_hz = rate_hz(ComponentType.ANALOG), rate_hz(ComponentType.FORCE)
    return RecordedParameters(
        encode_parameters(
            Parameters(
                markers=Parameters3D(
                    rate_hz(ComponentType.MARKERS),
                    markers=tuple(Marker(each, f"Marker {each}") for each in ids(ComponentType.MARKERS)),
                ),
                tools=Parameters6D(
                    rate_hz(ComponentType.TOOLS),
                    tuple(Tool(each, f"Tool {each}") for each in ids(ComponentType.TOOLS)),
                ),
                analog=ParametersAnalog(
                    tuple(
                        AnalogChannel(each, f"Analog {each}", frequency_hz=analog_hz)
                        for each in ids(ComponentType.ANALOG)
                    )
                ),
                force=ParametersForce(
                    tuple(
                        Plate(each, f"Force plate {each}", frequency_hz=force_hz)
                        for each in ids(ComponentType.FORCE)
                    )
                ),
                events=ParametersEvents(
                    tuple(
                        EventDefinition(str(event_id), f"Event {event_id}")
                        for event_id in sorted(set(event_ids))[:_MAX_EVENT_KINDS]
                    )
                ),
            )
        )
    )
