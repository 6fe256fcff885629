"""What an LSL stream says about itself: name, type, rate, channels and the rest of its XML.

The structure follows the meta-data recommendations of XDF, the file format of LabRecorder
(https://github.com/sccn/xdf/wiki/Meta-Data), so that its readers find labels, units and types.
"""

import hashlib
import re
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from gateway.descriptions.labels import Description, describe, fitting_labels, printable
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.rtc3d.components import ComponentType
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

_XYZ: Final = ("X", "Y", "Z")
_EMG: Final = re.compile(r"\bEMG", re.IGNORECASE)


class Channel(NamedTuple):
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
    channels: tuple[Channel, ...]
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


class DescribedSource(NamedTuple):
    """What all streams of a source have in common. ``computer`` is the name of the gateway's computer."""

    name: str
    computer: str
    parameters: Parameters
    frame: CoordinateFrame


class _Content(NamedTuple):
    """The type of a component's streams, and its channels and the things that they belong to."""

    type: str
    channels: tuple[Channel, ...]
    items: tuple[Tree, ...] = ()


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


def changed_labels(source: DescribedSource, component: ComponentType, num_items: int) -> dict[str, str]:
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


def channels_per_item(component: ComponentType) -> int:
    """Return how many channels one item of a component has."""
    return _CHANNELS_PER_ITEM[component]


def lsl_stream(source: DescribedSource, component: ComponentType, num_items: int) -> LslStream:
    """Return the description of the stream of a component with ``num_items`` items."""
    description = describe(component, source.parameters, num_items)
    content = _CONTENTS[component](_labels(description, component), description)
    rate_hz = _announced_rate_hz(description.rate_hz, len(content.channels))
    setup: tuple[Tree, ...] = (("name", source.name), *content.items)
    if component not in {ComponentType.ANALOG, ComponentType.EVENT}:
        setup = (("name", source.name), _frame_tree(source.frame), *content.items)
    facts = repr((content.channels, setup)).encode()
    digest = hashlib.blake2b(facts, digest_size=4).hexdigest()
    return LslStream(
        name=f"{source.name}_{component.key}",
        type=content.type,
        rate_hz=rate_hz,
        is_text=component is ComponentType.EVENT,
        source_id=f"rtc3d-gateway/{source.computer}/{source.name}/{component.key}/{digest}",
        channels=content.channels,
        setup=setup,
        acquisition=_acquisition(source.parameters),
    )


def _announced_rate_hz(rate_hz: float | None, num_channels: int) -> float:
    if rate_hz is None or not 0 < rate_hz <= min(MAX_RATE_HZ, MAX_VALUES_PER_S / max(num_channels, 1)):
        return 0.0
    return rate_hz


def _markers(labels: tuple[str, ...], _description: Description) -> _Content:
    channels = []
    for label in labels:
        channels += [Channel(f"{label}_{axis}", f"Position{axis}", _METRES, label) for axis in _XYZ]
        channels.append(Channel(f"{label}_reliability", "Reliability", "", label))
    markers = tuple(("marker", (("label", label),)) for label in labels)
    return _Content("MoCap", tuple(channels), (("markers", markers),))


def _tools(labels: tuple[str, ...], _description: Description) -> _Content:
    channels = []
    for label in labels:
        channels += [Channel(f"{label}_{axis}", f"Position{axis}", _METRES, "", label) for axis in _XYZ]
        # XDF calls the parts of a quaternion A to D, with the scalar first.
        for part, letter in (("X", "B"), ("Y", "C"), ("Z", "D"), ("W", "A")):
            channels.append(Channel(f"{label}_quat_{part}", f"Orientation{letter}", "quaternion", "", label))
        channels.append(Channel(f"{label}_error", "Error", _METRES, "", label))
    objects = tuple(("object", (("class", "Rigid"), ("label", label))) for label in labels)
    return _Content("MoCap", tuple(channels), (("objects", objects),))


def _analog(labels: tuple[str, ...], description: Description) -> _Content:
    channels = tuple(
        Channel(label, "EMG" if _EMG.search(label) else "Analog", printable(unit)[:_MAX_LABEL_BYTES])
        for label, unit in zip(labels, description.units, strict=True)
    )
    is_emg = bool(channels) and all(channel.type == "EMG" for channel in channels)
    return _Content("EMG" if is_emg else "Analog", channels)


def _plates(labels: tuple[str, ...], description: Description) -> _Content:
    channels = []
    moment_unit = printable(description.moment_unit)[:_MAX_LABEL_BYTES]
    for label, unit in zip(labels, description.units, strict=True):
        force_unit = printable(unit)[:_MAX_LABEL_BYTES]
        channels += [Channel(f"{label}_F{axis}", f"Force{axis}", force_unit, "", label) for axis in _XYZ]
        channels += [Channel(f"{label}_M{axis}", f"Moment{axis}", moment_unit, "", label) for axis in _XYZ]
    objects = tuple(("object", (("class", "ForcePlate"), ("label", label))) for label in labels)
    return _Content("Force", tuple(channels), (("objects", objects),))


def _events(_labels: tuple[str, ...], _description: Description) -> _Content:
    return _Content("Markers", (Channel("event", "Marker", ""),))


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
    return tuple((name, printable(text)[:_MAX_LABEL_BYTES]) for name, text in facts if text)


_LISTS: Final[Mapping[ComponentType, str]] = {
    ComponentType.MARKERS: "markers",
    ComponentType.TOOLS: "tools",
    ComponentType.ANALOG: "channels",
    ComponentType.FORCE: "plates",
    ComponentType.EVENT: "events",
}
"""The lists of items in the sections of the parameters."""

_CONTENTS: Final[Mapping[ComponentType, Callable[[tuple[str, ...], Description], _Content]]] = {
    ComponentType.MARKERS: _markers,
    ComponentType.TOOLS: _tools,
    ComponentType.ANALOG: _analog,
    ComponentType.FORCE: _plates,
    ComponentType.EVENT: _events,
}
_CHANNELS_PER_ITEM: Final[Mapping[ComponentType, int]] = {
    ComponentType.MARKERS: 4,
    ComponentType.TOOLS: 8,
    ComponentType.ANALOG: 1,
    ComponentType.FORCE: 6,
    ComponentType.EVENT: 1,
}
