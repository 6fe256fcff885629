"""The labels of a source's items on ROS 2, so that nodes find the names of what is in other messages."""

from collections.abc import Mapping
from typing import Final

from gateway.messages.ros2.encode import DiagnosticStatus, diagnostic_array
from gateway.rtc3d.components import ComponentType

MAX_LABELS: Final = 4096
"""How many labels of a component are published: a frame may have any number of markers and channels."""

Labels = dict[ComponentType, Mapping[str, str]]
"""By component: labels by what stands for the items in topics.

That is the index for markers in a cloud and for channels, and a part of the topic for tools and plates.
"""

_OK: Final = 0

_NAMES: Final = {
    ComponentType.MARKERS: "markers",
    ComponentType.TOOLS: "tools",
    ComponentType.ANALOG: "analog",
    ComponentType.FORCE: "force",
}


def labels_message(stamp: bytes, source: str, labels: Labels) -> bytes:
    """Return a diagnostic_msgs/DiagnosticArray with a status for each component, in a constant order."""
    return diagnostic_array(
        stamp,
        [
            DiagnosticStatus(_OK, name, "", source, labels[component])
            for component, name in _NAMES.items()
            if component in labels
        ],
    )


def by_index(labels: tuple[str, ...]) -> dict[str, str]:
    """Return labels of markers or channels by their indices, from 0; those beyond MAX_LABELS are left out."""
    return {str(index): label for index, label in enumerate(labels[:MAX_LABELS])}
