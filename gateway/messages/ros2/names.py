"""The names of topics of ROS 2.

A topic consists of parts between slashes: ASCII letters, digits and single underscores, without a digit or an
underscore at the beginning. (A part with a leading underscore is hidden from ``ros2 topic list``.)
"""

import re
from collections.abc import Mapping, Sequence
from typing import Final

from gateway.messages.topics import unique_name
from gateway.messages.transliteration import without_accents

DEFAULT_NAMESPACE: Final = "mocap"

TF: Final = "/tf"
TF_STATIC: Final = "/tf_static"
MARKERS: Final = "markers"
ANALOG: Final = "analog"
EVENTS: Final = "events"
LABELS: Final = "labels"
"""The topics of markers, channels, events and labels, below that of their source."""

_MAX_LABEL_CHARS: Final = 48
MAX_PART_CHARS: Final = 63
"""How much of a label is kept, and the maximum length of a part, with a noun and a number.

ROS accepts topics of at most 247 characters.
"""


NO_NAMES: Final[Mapping[str, str]] = {}

PLATE_NAME: Final = re.compile(r"force_\d+")
"""What ``plate_name`` returns; no tool may be called so."""


def ros_name(text: str, noun: str) -> str:
    """Return ``text`` as a part of a topic; ``noun`` begins it if it has no letter at its beginning.

    "Left Foot" becomes Left_Foot, "2nd" with the noun tool becomes tool_2nd, "Fuß" becomes Fuss.
    """
    name = re.sub("[^A-Za-z0-9]+", "_", without_accents(text)).strip("_")[:_MAX_LABEL_CHARS].rstrip("_")
    if name and name[0].isdigit():
        return f"{noun}_{name}"
    return name or noun


def unique_ros_names(
    labels: Sequence[str], noun: str, chosen: Mapping[str, str] = NO_NAMES
) -> tuple[str, ...]:
    """Return a different part of a topic for each of the labels, which differ.

    ``chosen`` has the names of some labels. For others, a name that is chosen, or that an earlier label has,
    gets _2, _3, …. A label without any usable character is called by its position, such as tool_3.
    """
    taken = set(chosen.values())
    names = []
    for position, label in enumerate(labels, start=1):
        name = chosen.get(label)
        if name is None:
            name = ros_name(label, noun)
            if name == noun:
                name = f"{noun}_{position}"
            elif PLATE_NAME.fullmatch(name):
                name = f"{noun}_{name}"  # on /tf, plates and tools are side by side
            name = unique_name(name, taken, MAX_PART_CHARS)
            taken.add(name)
        names.append(name)
    return tuple(names)


def pose_topic(tool: str) -> str:
    """Return the topic of a tool, below that of its source; ``tool`` is one of ``unique_ros_names``."""
    return f"{tool}/pose"


def plate_name(number: int) -> str:
    """Return the name of a force plate, counted from 1."""
    return f"force_{number}"


def wrench_topic(plate: str) -> str:
    """Return the topic of the load on a force plate, below that of its source."""
    return f"{plate}/wrench"


def pressure_topic(plate: str) -> str:
    """Return the topic of the centre of pressure on a force plate, below that of its source."""
    return f"{plate}/centre_of_pressure"
