"""What a server's parameters (§6) say about one component: its rate, its items and their labels."""

from collections.abc import Collection
from dataclasses import replace
from typing import Final

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters, Parameters3D, only_sections

_MIN_HZ: Final = 0.01
_MAX_HZ: Final = 1e6
"""Numbers outside this range are not rates. Time stamps are whole µs (§7.1)."""


def described_rate_hz(parameters: Parameters, component: ComponentType) -> float | None:
    """Return the rate at which the server samples ``component``, in Hz; None if the parameters lack it.

    For analog and force, this is the highest rate of a channel or plate. A number that cannot be a rate, such
    as 0 for "not measured", counts as none.
    """
    rate_hz = _described_number(parameters, component)
    return rate_hz if rate_hz is not None and _MIN_HZ <= rate_hz <= _MAX_HZ else None


def _described_number(parameters: Parameters, component: ComponentType) -> float | None:
    match component:
        case ComponentType.MARKERS:
            return parameters.markers.frequency_hz if parameters.markers else None
        case ComponentType.TOOLS:
            return parameters.tools.frequency_hz if parameters.tools else None
        case ComponentType.ANALOG:
            channels = parameters.analog.channels if parameters.analog else ()
            return max((channel.frequency_hz or 0 for channel in channels), default=None)
        case ComponentType.FORCE:
            plates = parameters.force.plates if parameters.force else ()
            return max((plate.frequency_hz or 0 for plate in plates), default=None)
        case _:
            return None


def num_described_items(parameters: Parameters, component: ComponentType) -> int:
    """Return the number of markers, tools, channels or plates in the parameters; 0 for events."""
    match component:
        case ComponentType.MARKERS:
            return len(parameters.markers.markers) if parameters.markers else 0
        case ComponentType.TOOLS:
            return len(parameters.tools.tools) if parameters.tools else 0
        case ComponentType.ANALOG:
            return len(parameters.analog.channels) if parameters.analog else 0
        case ComponentType.FORCE:
            return len(parameters.force.plates) if parameters.force else 0
        case _:
            return 0


def described_labels(parameters: Parameters, component: ComponentType) -> list[str]:
    """Return the labels of the markers or tools, in their order in a frame; [] for other components."""
    if component is ComponentType.MARKERS and parameters.markers:
        return [marker.label for marker in parameters.markers.markers]
    if component is ComponentType.TOOLS and parameters.tools:
        return [tool.label for tool in parameters.tools.tools]
    return []


def only_components(parameters: Parameters, components: Collection[ComponentType]) -> Parameters:
    """Return the parameters without the items of other components. The unit of all positions remains."""
    sections = {"events" if each is ComponentType.EVENT else each.key for each in components}
    kept = only_sections(parameters, {"general", *sections})
    if parameters.markers is not None and kept.markers is None:
        return replace(kept, markers=Parameters3D(unit=parameters.length_unit))
    return kept
