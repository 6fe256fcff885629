"""What an LSL stream says about itself: name, type, rate, channels and the rest of its XML.

The structure follows the meta-data recommendations of XDF, the file format of LabRecorder
(https://github.com/sccn/xdf/wiki/Meta-Data), so that its readers find labels, units and types.
"""

import hashlib
import re
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.descriptions.labels import Description, describe, fitting_labels, printable
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.parameters import SECTIONS, Parameters

Tree = tuple[str, "str | tuple[Tree, ...]"]
"""An XML element: its name, and its text or its children."""

MAX_CHANNELS: Final = 60_000
"""A component with more channels gets no stream. The server determines the number of items."""

MAX_RATE_HZ: Final = 100_000.0
MAX_VALUES_PER_S: Final = 2_500_000.0
"""A stream with more is announced without a rate: liblsl reserves memory for 5 s of the announced rate."""

_MAX_LABEL_BYTES: Final = 120
_METRES: Final = "meters"  # XDF's word

_SYNCHRONIZATION: Final[Tree] = ("synchronization", (("can_drop_samples", "true"),))
"""Has readers of XDF keep the time stamps.

Otherwise they take small gaps for jitter and space the samples evenly, which shifts them by up to half of
each gap. (https://github.com/sccn/xdf/wiki/Synchronization)
"""

_EMG: Final = re.compile(r"\bEMG", re.IGNORECASE)


class LslChannel(NamedTuple):
    """One channel. ``marker`` and ``object`` are the labels of the marker or the tool that it belongs to."""

    label: str
    type: str
    unit: str
    marker: str = ""
    object: str = ""

    @property
    def tree(self) -> Tree:
        """The channel as XML, without what it does not have."""
        return "channel", tuple((name, text) for name, text in self._asdict().items() if text)


class LslStream(NamedTuple):
    """The description of one stream. ``rate_hz`` is 0 if samples have no regular rate.

    A stream has one text per sample (``is_text``), or 32-bit floats. Programs that have lost a stream
    continue with the next one of the same ``source_id``, so it is different for other channels.
    """

    name: str
    type: str
    rate_hz: float
    is_text: bool
    source_id: str
    channels: tuple[LslChannel, ...]
    setup: tuple[Tree, ...]
    acquisition: tuple[Tree, ...]

    @property
    def tree(self) -> tuple[Tree, ...]:
        """The children of ``desc`` in the stream's XML."""
        return (
            ("channels", tuple(channel.tree for channel in self.channels)),
            ("setup", self.setup),
            ("acquisition", self.acquisition),
            _SYNCHRONIZATION,
        )


class LslSource(NamedTuple):
    """What all streams of a source have in common. ``computer`` is the name of the gateway's computer."""

    name: str
    computer: str
    parameters: Parameters
    frame: CoordinateFrame


def num_labels(component: ComponentType, parameters: Parameters) -> int | None:
    """Return how many items of a component the parameters describe; None if they lack its section."""
    items = _described_items(component, parameters)
    return None if items is None else len(items)


def _described_items(component: ComponentType, parameters: Parameters) -> tuple[Any, ...] | None:
    section = SECTIONS["events" if component is ComponentType.EVENT else component.key].of(parameters)
    if section is None:
        return None
    items: tuple[Any, ...] = getattr(section, _LISTS[component])
    return items


def changed_labels(source: LslSource, component: ComponentType, num_items: int) -> dict[str, str]:
    """Return the names in the stream of items whose labels it cannot use as they are, by their labels."""
    if component is ComponentType.EVENT:
        return {}
    items = _described_items(component, source.parameters) or ()
    names = _labels(describe(component, source.parameters, num_items), component)
    pairs = zip((item.label for item in items), names, strict=False)
    return {label: name for label, name in pairs if label.strip() and label != name}


def _labels(description: Description, component: ComponentType) -> tuple[str, ...]:
    noun = component.item_noun.removesuffix("s")
    return fitting_labels(description.labels, printable, _MAX_LABEL_BYTES, noun)


def lsl_stream(source: LslSource, component: ComponentType, num_items: int) -> LslStream:
    """Return the description of the stream of a component with ``num_items`` items."""
    description = describe(component, source.parameters, num_items)
    labels = _labels(description, component)
    channels = _channels(component, labels, description)
    rate_hz = description.rate_hz
    if rate_hz is None or not 0 < rate_hz <= min(MAX_RATE_HZ, MAX_VALUES_PER_S / max(len(channels), 1)):
        rate_hz = 0.0
    setup: list[Tree] = [("name", source.name)]
    if component not in {ComponentType.ANALOG, ComponentType.EVENT}:
        setup.append(_frame_tree(source.frame))
    if component is ComponentType.MARKERS:
        setup.append(("markers", tuple(("marker", (("label", label),)) for label in labels)))
    elif component in _OBJECTS:
        kind = ("class", _OBJECTS[component])
        setup.append(("objects", tuple(("object", (kind, ("label", label))) for label in labels)))
    is_emg = bool(channels) and all(channel.type == "EMG" for channel in channels)
    digest = hashlib.blake2b(repr((channels, tuple(setup))).encode(), digest_size=4).hexdigest()
    return LslStream(
        name=f"{source.name}_{component.key}",
        type="EMG" if is_emg else _TYPES[component],
        rate_hz=rate_hz,
        is_text=component is ComponentType.EVENT,
        source_id=f"rtc3d-gateway/{source.computer}/{source.name}/{component.key}/{digest}",
        channels=channels,
        setup=tuple(setup),
        acquisition=_acquisition(source.parameters),
    )


def _channels(
    component: ComponentType, labels: tuple[str, ...], description: Description
) -> tuple[LslChannel, ...]:
    if component is ComponentType.EVENT:
        return (LslChannel("event", "Marker", ""),)
    if component is ComponentType.ANALOG:
        types = ["EMG" if _EMG.search(label) else "Analog" for label in labels]
        return tuple(map(LslChannel, labels, types, map(_short, description.units)))
    channels = []
    for index, label in enumerate(labels):
        owner = (label, "") if component is ComponentType.MARKERS else ("", label)
        for suffix, kind, unit in _ITEM_CHANNELS[component]:
            if component is ComponentType.FORCE:
                is_moment = kind.startswith("Moment")
                unit = _short(description.moment_unit if is_moment else description.units[index])  # noqa: PLW2901
            channels.append(LslChannel(f"{label}_{suffix}", kind, unit, *owner))
    return tuple(channels)


def _frame_tree(frame: CoordinateFrame) -> Tree:
    """Return the coordinate frame of the positions, and how it was made from the server's."""
    rotation = tuple(zip("xyzw", map(repr, frame.rotation_xyzw), strict=True))
    translation = tuple(zip("xyz", map(repr, frame.translation_m), strict=True))
    return (
        "coordinate_frame",
        (
            ("frame_id", printable(frame.frame_id)),
            ("metres_per_server_unit", str(frame.metres_per_unit)),
            ("rotation_from_server", rotation),
            ("translation_from_server", translation),
        ),
    )


def _acquisition(parameters: Parameters) -> tuple[Tree, ...]:
    general = parameters.general
    facts = (
        ("model", general.name if general else ""),
        ("version", general.version if general else ""),
        ("protocol", "RTC3D"),
        ("time_stamps", "capture time of the server's frames"),
    )
    return tuple((name, _short(text)) for name, text in facts if text)


def _short(text: str) -> str:
    return printable(text)[:_MAX_LABEL_BYTES]


_LISTS: Final[Mapping[ComponentType, str]] = {
    ComponentType.MARKERS: "markers",
    ComponentType.TOOLS: "tools",
    ComponentType.ANALOG: "channels",
    ComponentType.FORCE: "plates",
    ComponentType.EVENT: "events",
}
"""The lists of items in the sections of the parameters."""

_TYPES: Final[Mapping[ComponentType, str]] = {
    ComponentType.MARKERS: "MoCap",
    ComponentType.TOOLS: "MoCap",
    ComponentType.ANALOG: "Analog",
    ComponentType.FORCE: "Force",
    ComponentType.EVENT: "Markers",
}
_OBJECTS: Final[Mapping[ComponentType, str]] = {
    ComponentType.TOOLS: "Rigid",
    ComponentType.FORCE: "ForcePlate",
}
"""The classes of objects in XDF."""

_POSITION: Final = tuple((axis, f"Position{axis}", _METRES) for axis in "XYZ")
_ITEM_CHANNELS: Final[Mapping[ComponentType, tuple[tuple[str, str, str], ...]]] = {
    ComponentType.MARKERS: (*_POSITION, ("reliability", "Reliability", "")),
    ComponentType.TOOLS: (
        *_POSITION,
        # XDF calls the parts of a quaternion A to D, with the scalar first.
        *(
            (f"quat_{part}", f"Orientation{letter}", "quaternion")
            for part, letter in ("XB", "YC", "ZD", "WA")
        ),
        ("error", "Error", _METRES),
    ),
    ComponentType.FORCE: tuple(
        (f"{kind[0]}{axis}", f"{kind}{axis}", "") for kind in ("Force", "Moment") for axis in "XYZ"
    ),
}
"""The channels of one item: what their labels end with, their types, and their units, if these are fixed."""

CHANNELS_PER_ITEM: Final[Mapping[ComponentType, int]] = {
    component: len(_ITEM_CHANNELS.get(component, ("",))) for component in WIRE_ORDER
}
