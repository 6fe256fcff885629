"""What a server's parameters (§6) say about one component."""

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters


def described_rate_hz(parameters: Parameters, component: ComponentType) -> float | None:
    """Return the rate at which the server samples ``component``; None if the parameters do not say."""
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


def described_items(parameters: Parameters, component: ComponentType) -> int:
    """Return how many markers, tools, channels or plates the parameters list; 0 for events."""
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
    """Return the labels of the markers or tools, in the order of the frames; [] for other components."""
    if component is ComponentType.MARKERS and parameters.markers:
        return [marker.label for marker in parameters.markers.markers]
    if component is ComponentType.TOOLS and parameters.tools:
        return [tool.label for tool in parameters.tools.tools]
    return []
