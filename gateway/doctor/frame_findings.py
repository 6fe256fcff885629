"""What the doctor makes of the frames of one stream that it watched."""

from collections.abc import Mapping, Sequence
from typing import Final

from gateway.doctor.finding import Finding, Patient
from gateway.doctor.observation import ComponentSeen, StreamWatch
from gateway.rtc3d.commands import Frequency, FrequencyDivisor
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.stream.state import StreamState

SLOW: Final = 0.9
"""A component that comes at less than this share of its rate is too slow."""

MIN_VISIBLE: Final = 0.5
"""Fewer markers or tools in view than this share are a fault."""

_MAX_NAMES: Final = 5
_COUNTED: Final = {ComponentType.MARKERS: "markers", ComponentType.TOOLS: "tools"}

VISIBLE: Final = frozenset(_COUNTED)
"""The components whose items can be out of view."""


def frames_finding(patient: Patient, watch: StreamWatch, announced: Parameters | None) -> Finding:
    """Return whether frames come, of what was asked for, and hold together."""
    of = f"of {watch.components} " if len(watch.stream.components) < len(ComponentType) else ""
    if not watch.session.is_open:
        return patient.bad(
            "frames",
            f"the server ended the connection {of}while frames were awaited",
            "Is another program taking the stream over? Look into the server's own messages.",
        )
    rejected = watch.status.drops["frame rejected"]
    if rejected:
        return patient.bad(
            "frames",
            f"{rejected} of {rejected + watch.status.frames_in} frames {of}contradict themselves: "
            f"{watch.status.last_error.removeprefix('frame rejected: ')}",
            "The gateway drops such frames. Update the server's software, or tell its maker of this.",
        )
    missing = [
        component
        for component in watch.stream.components
        if component not in watch.seen and _announced_items(announced, component)
    ]
    if watch.seen and missing:
        names = ", ".join(component.key for component in missing)
        return patient.bad(
            "frames",
            f"the server announces {names}, was asked for it, and does not send it",
            f"Switch on the real-time output of {names} on the server, or take it out of the stream's "
            "components.",
        )
    if watch.seen:
        names = ", ".join(component.key for component in watch.stream.components if component in watch.seen)
        largest = max(seen.message_bytes for seen in watch.seen.values())
        return patient.good(
            "frames", f"{watch.status.frames_in} frames with {names}; messages of {largest} bytes at most"
        )
    return _no_frames(patient, watch, of)


def _no_frames(patient: Patient, watch: StreamWatch, of: str) -> Finding:
    if watch.status.state is StreamState.NO_MEASUREMENT:
        return patient.bad(
            "frames",
            "the server says that no measurement runs",
            "Start one on the server; the gateway waits for it and then streams by itself.",
        )
    if watch.stream.components == (ComponentType.EVENT,):
        return patient.untested("frames", "events come when they come, and none came meanwhile")
    return patient.bad(
        "frames",
        f"no frame {of}came, and no word that no measurement runs",
        "Look whether the server shows live data and its real-time output is on; ask for other "
        "components; watch longer with --seconds.",
    )


def rate_finding(patient: Patient, watch: StreamWatch, announced: Parameters | None) -> Finding:
    """Return whether each component comes at the rate announced, or at the lower one asked for."""
    rates_hz: dict[ComponentType, float] = {
        component: seen.rate_hz
        for component, seen in watch.seen.items()
        if component is not ComponentType.EVENT and seen.rate_hz > 0
    }
    if not rates_hz:
        return patient.untested("rate", "too few frames to tell it")
    expected_hz = _expected_hz(watch, announced)
    unknown = [component for component in rates_hz if component not in expected_hz]
    texts = [
        f"{component.key} {_hz(rate)}"
        + ("" if component in unknown else f" of {_hz(expected_hz[component])}")
        for component, rate in rates_hz.items()
    ]
    found = f"{', '.join(texts)} Hz"
    if len(unknown) == len(rates_hz):
        return patient.untested("rate", f"{found}; the server announces none to compare with")
    slow = [
        component
        for component in rates_hz
        if component in expected_hz and rates_hz[component] < SLOW * expected_hz[component]
    ]
    if not slow:
        return patient.good("rate", found)
    names = " and ".join(component.key for component in slow)
    if _held_back(slow, rates_hz, expected_hz):
        return patient.bad(
            "rate",
            found,
            f"A stream is as fast as its slowest component: put {names} into another one in the source's "
            "streams, or ask for a lower rate.",
        )
    return patient.bad(
        "rate",
        found,
        "The server does not keep up, or the network: look at its real-time processing rate and load, "
        "at the cable and switch; or ask for less with the stream's rate.",
    )


def _held_back(
    slow: Sequence[ComponentType],
    rates_hz: Mapping[ComponentType, float],
    expected_hz: Mapping[ComponentType, float],
) -> bool:
    """Return whether the slow ones come exactly as fast as a slower component of the stream does."""
    others_hz = [expected_hz[other] for other in rates_hz if other in expected_hz and other not in slow]
    return bool(others_hz) and all(
        SLOW * min(others_hz) <= rates_hz[component] <= min(others_hz) / SLOW for component in slow
    )


def _expected_hz(watch: StreamWatch, announced: Parameters | None) -> dict[ComponentType, float]:
    """Return the rate that each component should come at, of those whose rate is announced.

    A divisor counts what the server processes for the stream, which is its slowest component (§5.3.5).
    """
    rates_hz = {
        component: rate
        for component in watch.seen
        if (rate := _announced_hz(announced, component)) is not None and rate > 0
    }
    match watch.stream.rate:
        case Frequency(hz):
            return {component: min(rate, hz) for component, rate in rates_hz.items()}
        case FrequencyDivisor(divisor):
            return {component: min(rates_hz.values()) / divisor for component in rates_hz}
        case _:
            return rates_hz


def _announced_hz(announced: Parameters | None, component: ComponentType) -> float | None:
    if announced is None:
        return None
    match component:
        case ComponentType.MARKERS:
            return announced.markers.frequency_hz if announced.markers else None
        case ComponentType.TOOLS:
            return announced.tools.frequency_hz if announced.tools else None
        case ComponentType.ANALOG:
            channels = announced.analog.channels if announced.analog else ()
            return max((channel.frequency_hz or 0 for channel in channels), default=None)
        case ComponentType.FORCE:
            plates = announced.force.plates if announced.force else ()
            return max((plate.frequency_hz or 0 for plate in plates), default=None)
        case _:
            return None


def _announced_items(announced: Parameters | None, component: ComponentType) -> int:
    """Return how many markers, tools, channels or plates the server announces; 0 of events."""
    if announced is None:
        return 0
    match component:
        case ComponentType.MARKERS:
            return len(announced.markers.markers) if announced.markers else 0
        case ComponentType.TOOLS:
            return len(announced.tools.tools) if announced.tools else 0
        case ComponentType.ANALOG:
            return len(announced.analog.channels) if announced.analog else 0
        case ComponentType.FORCE:
            return len(announced.force.plates) if announced.force else 0
        case _:
            return 0


def visibility_finding(patient: Patient, watch: StreamWatch, announced: Parameters | None) -> Finding:
    """Return whether markers and tools are in view."""
    shares = {
        component: share
        for component in _COUNTED
        if component in watch.seen and (share := watch.seen[component].visible_share) is not None
    }
    if not shares:
        return patient.untested("visibility", "no markers or tools came")
    found = ", ".join(
        f"{_COUNTED[component]} {share:.0%}{_never(watch.seen[component], component, announced)}"
        for component, share in shares.items()
    )
    if min(shares.values()) >= MIN_VISIBLE:
        return patient.good("visibility", f"in view: {found}")
    return patient.bad(
        "visibility",
        f"in view: {found}",
        "Look whether the cameras see the volume, markers are in it and not covered, and strobers are "
        "on and charged.",
    )


def _never(seen: ComponentSeen, component: ComponentType, announced: Parameters | None) -> str:
    """Return " (never NAMES)" for those that were in view in no frame; nothing if all or none were."""
    indices = seen.never_visible
    if not indices or not seen.visible_share:
        return ""
    labels: list[str] = []
    if announced is not None and component is ComponentType.MARKERS and announced.markers:
        labels = [marker.label for marker in announced.markers.markers]
    if announced is not None and component is ComponentType.TOOLS and announced.tools:
        labels = [tool.label for tool in announced.tools.tools]
    names = [(labels[index] if index < len(labels) else "") or f"number {index + 1}" for index in indices]
    more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    return f" (never {', '.join(names[:_MAX_NAMES])}{more})"


def _hz(rate: float) -> str:
    return f"{rate:.1f}".removesuffix(".0")
