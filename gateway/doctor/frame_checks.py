"""Checks of the frames that one stream received: completeness, and visibility of markers and tools."""

from typing import Final

from gateway.doctor.observation import COMPONENTS_WITH_VISIBILITY, ObservedComponent, ObservedStream
from gateway.findings import Finding, Subject
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.rtc3d.server_description import described_labels, num_described_items
from gateway.stream.state import StreamState
from gateway.stream.status import FRAME_REJECTED

_MIN_VISIBLE: Final = 0.5
"""The check fails if a smaller share of the markers, or of the tools, is in view."""

_MAX_NAMES: Final = 5
"""How many markers or tools a finding names."""


def check_frames(subject: Subject, stream: ObservedStream, parameters: Parameters | None) -> Finding:
    """Check that well-formed frames arrive, with every component that the stream requested."""
    is_partial = len(stream.settings.components) < len(ComponentType)
    of_stream = f" of stream {stream.component_keys}" if is_partial else ""
    if not stream.session.is_open:
        return subject.failing(
            "frames",
            f"the server closed the connection{of_stream} while the doctor waited for frames",
            "Check whether another program takes over the stream, and read the server's own messages.",
        )
    if stream.status.losses.frames(FRAME_REJECTED):
        return _malformed_frames(subject, stream, of_stream)
    if not stream.observed:
        return _no_frames(subject, stream, of_stream)
    missing = _missing_components(stream, parameters)
    if missing:
        names = ", ".join(missing)
        return subject.failing(
            "frames",
            f"the server's parameters list items of {names}, but no frame contains {names}",
            f"Enable the real-time output of {names} on the server, or remove {names} from the stream's "
            "components.",
        )
    names = ", ".join(
        component.key for component in stream.settings.components if component in stream.observed
    )
    largest = max(component.message_load.largest_bytes for component in stream.observed.values())
    return subject.passing(
        "frames", f"{stream.status.frames_in} frames with {names}; the largest message has {largest} bytes"
    )


def _malformed_frames(subject: Subject, stream: ObservedStream, of_stream: str) -> Finding:
    rejected = stream.status.losses.frames(FRAME_REJECTED)
    return subject.failing(
        "frames",
        f"{rejected} of {rejected + stream.status.frames_in} frames{of_stream} are malformed: "
        f"{stream.status.last_error.removeprefix('frame rejected: ')}",
        "The gateway drops malformed frames. Update the server's software, or report this to its maker.",
    )


def _missing_components(stream: ObservedStream, parameters: Parameters | None) -> list[str]:
    """Return the keys of the components that the parameters describe but no frame contains."""
    return [
        component.key
        for component in stream.settings.components
        if parameters and component not in stream.observed and num_described_items(parameters, component)
    ]


def _no_frames(subject: Subject, stream: ObservedStream, of_stream: str) -> Finding:
    if stream.status.state is StreamState.NO_MEASUREMENT:
        return subject.failing(
            "frames",
            "the server reports that no measurement is running",
            "Start a measurement on the server; the gateway then streams automatically.",
        )
    if stream.settings.components == (ComponentType.EVENT,):
        return subject.not_tested("frames", "no event occurred during the check")
    return subject.failing(
        "frames",
        f"no frame{of_stream} arrived, and the server did not report that no measurement is running",
        "Check that the server shows live data and that its real-time output is enabled. Try other "
        "components in the stream, or watch longer with --seconds.",
    )


def check_visibility(subject: Subject, stream: ObservedStream, parameters: Parameters | None) -> Finding:
    """Check that at least half of the markers and half of the tools are in view."""
    shares = {
        component: share
        for component in COMPONENTS_WITH_VISIBILITY
        if component in stream.observed and (share := stream.observed[component].visible_share) is not None
    }
    if not shares:
        return subject.not_tested("visibility", "no markers or tools arrived")
    texts = ", ".join(
        f"{component.item_noun} {share:.0%}"
        f"{_never_visible(stream.observed[component], component, parameters)}"
        for component, share in shares.items()
    )
    found = f"in view: {texts}"
    if min(shares.values()) >= _MIN_VISIBLE:
        return subject.passing("visibility", found)
    return subject.failing(
        "visibility",
        found,
        "Check that the cameras see the volume, that the markers are inside it and not covered, and that the "
        "strobers are on and charged.",
    )


def _never_visible(
    observed: ObservedComponent, component: ComponentType, parameters: Parameters | None
) -> str:
    """Return " (never NAMES)" for the items that were never in view; "" if these are all items or none."""
    indices = observed.never_visible_indices
    if not indices or not observed.visible_share:
        return ""
    labels = described_labels(parameters, component) if parameters else []
    names = [(labels[index] if index < len(labels) else "") or f"number {index + 1}" for index in indices]
    more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    return f" (never {', '.join(names[:_MAX_NAMES])}{more})"
