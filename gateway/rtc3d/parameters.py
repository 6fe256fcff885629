"""The parameters of §6 as typed, frozen objects, their layout in XML, and questions about them.

``parameters_xml`` reads and writes them.

A text that the server did not send is "" (or its default in §6, such as mm), a number is None. Ids are the
server's own texts: numbers may start anywhere (field note 9), and an event's id may be hexadecimal.
"""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from math import nan
from typing import Any, Final, NamedTuple

from gateway.logs.safe_text import quoted


@dataclass(frozen=True, slots=True)
class General:
    """§6.1: the server and its average streaming performance during a session."""

    name: str = ""
    version: str = ""
    address: str = ""
    port: int | None = None
    frames_sent: int | None = None
    frames_per_s: float | None = None


@dataclass(frozen=True, slots=True)
class Marker:
    """One marker of §6.2."""

    id: str
    label: str = ""
    description: str = ""


@dataclass(frozen=True, slots=True)
class Parameters3D:
    """§6.2: the markers, in the order of the 3D component."""

    frequency_hz: float | None = None
    unit: str = "mm"
    markers: tuple[Marker, ...] = ()


@dataclass(frozen=True, slots=True)
class Tool:
    """One tool of §6.3; ``marker_ids`` are ids of 3D markers, in the order of the tool's definition."""

    id: str
    label: str = ""
    description: str = ""
    marker_ids: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Parameters6D:
    """§6.3: the tools, in the order of the 6D component."""

    frequency_hz: float | None = None
    tools: tuple[Tool, ...] = ()


@dataclass(frozen=True, slots=True)
class AnalogChannel:
    """One channel of §6.4."""

    id: str
    label: str = ""
    description: str = ""
    unit: str = "mV"
    frequency_hz: float | None = None


@dataclass(frozen=True, slots=True)
class ParametersAnalog:
    """§6.4: the channels, in the order of the Analog component."""

    channels: tuple[AnalogChannel, ...] = ()


@dataclass(frozen=True, slots=True)
class Point:
    """A position of §6.5, in ``unit``; a coordinate that the server did not send is NaN."""

    x: float = nan
    y: float = nan
    z: float = nan
    unit: str = "mm"


@dataclass(frozen=True, slots=True)
class ForceChannel:
    """One force or moment channel of a plate (§6.5)."""

    id: str
    label: str = ""
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Plate:
    """One force plate of §6.5.

    ``corners`` are the plate's four corners in the laboratory, ``origin`` the transducer's origin.
    ``analog_channel_ids`` are ids of the raw analog channels. ``calibration_matrix`` is a tuple of rows;
    a cell that cannot be read is NaN.
    """

    id: str
    label: str = ""
    frequency_hz: float | None = None
    corners: tuple[Point, ...] = ()
    origin: Point | None = None
    channels: tuple[ForceChannel, ...] = ()
    analog_channel_ids: tuple[str, ...] = ()
    excitation_voltage_v: float | None = None
    amplifier_gain: float | None = None
    calibration_unit: str = ""
    calibration_matrix: tuple[tuple[float, ...], ...] = ()


@dataclass(frozen=True, slots=True)
class ParametersForce:
    """§6.5: the plates, in the order of the Force component."""

    plates: tuple[Plate, ...] = ()


@dataclass(frozen=True, slots=True)
class ExpectedValue:
    """One of the values that an event's parameter can have (§6.6)."""

    id: str
    value: str = ""
    label: str = ""
    description: str = ""


@dataclass(frozen=True, slots=True)
class EventParameter:
    """One of up to three parameters of an event (§6.6); ``type`` is int, float or string (4 characters)."""

    id: str
    type: str = "int"
    description: str = ""
    expected_values: tuple[ExpectedValue, ...] = ()


@dataclass(frozen=True, slots=True)
class EventDefinition:
    """One kind of event of §6.6; ``id`` is the server's text, decimal or 0x…."""

    id: str
    label: str = ""
    description: str = ""
    parameters: tuple[EventParameter, ...] = ()


@dataclass(frozen=True, slots=True)
class ParametersEvents:
    """§6.6: the events that the server is ready to send."""

    events: tuple[EventDefinition, ...] = ()


@dataclass(frozen=True, slots=True)
class Parameters:
    """The content of one XML reply; a section that it lacks is None. SECTIONS below lists the sections."""

    general: General | None = None
    markers: Parameters3D | None = None
    tools: Parameters6D | None = None
    analog: ParametersAnalog | None = None
    force: ParametersForce | None = None
    events: ParametersEvents | None = None

    @property
    def length_unit(self) -> str:
        """The unit of all positions, also of tools: that of the 3D section, and its default without one."""
        return (self.markers or Parameters3D()).unit


ROOT: Final = "RT_Parameters"


class Field(NamedTuple):
    """The place of a dataclass's field in XML: ``path`` leads there from the dataclass's element.

    If a step of ``path`` ends in *, the element is repeated and the field is a tuple. @id is the attribute.
    ``kind`` is str, int, float or a dataclass in LAYOUT. If it ``may_be_empty``, an empty text does not
    become the default.
    """

    name: str
    path: str
    kind: type = str
    may_be_empty: bool = False


_ID_LABEL_DESCRIPTION: Final = (
    Field("id", "@id"),
    Field("label", "Label"),
    Field("description", "Description"),
)
LAYOUT: Final[dict[type, tuple[Field, ...]]] = {
    Parameters: (
        Field("general", "General", General),
        Field("markers", "The_3D", Parameters3D),
        Field("tools", "The_6D", Parameters6D),
        Field("analog", "Analog", ParametersAnalog),
        Field("force", "Force", ParametersForce),
        Field("events", "Events", ParametersEvents),
    ),
    General: (
        Field("name", "Server/Name"),
        Field("version", "Server/Ver"),
        Field("address", "Server/IPadd"),
        Field("port", "Server/Port", int),
        Field("frames_sent", "Server/Stats/FramesSent", int),
        Field("frames_per_s", "Server/Stats/FramesPerSec", float),
    ),
    Parameters3D: (
        Field("frequency_hz", "Frequency", float),
        Field("unit", "Unit"),
        Field("markers", "Markers/Marker*", Marker),
    ),
    Marker: _ID_LABEL_DESCRIPTION,
    Parameters6D: (
        Field("frequency_hz", "Frequency", float),
        Field("tools", "Tools/Tool*", Tool),
    ),
    Tool: (*_ID_LABEL_DESCRIPTION, Field("marker_ids", "Markers/Marker*/@id")),
    ParametersAnalog: (Field("channels", "Channels/Channel*", AnalogChannel),),
    AnalogChannel: (
        *_ID_LABEL_DESCRIPTION,
        Field("unit", "Unit", may_be_empty=True),
        Field("frequency_hz", "Frequency", float),
    ),
    ParametersForce: (Field("plates", "Plates/Plate*", Plate),),
    Plate: (
        Field("id", "@id"),
        Field("frequency_hz", "Frequency", float),
        Field("label", "Label"),
        Field("corners", "Location/Corner*", Point),
        Field("origin", "Origin", Point),
        Field("channels", "Channels/Channel*", ForceChannel),
        Field("analog_channel_ids", "AnalogChannels/Channel*/@id"),
        Field("excitation_voltage_v", "ExcitationVoltage", float),
        Field("amplifier_gain", "AmplifierGain", float),
        Field("calibration_unit", "Calibration_Matrix/Unit"),
        Field("calibration_matrix", "Calibration_Matrix/Row*/Col*", float),
    ),
    Point: (
        Field("unit", "Unit"),
        Field("x", "Point/X", float),
        Field("y", "Point/Y", float),
        Field("z", "Point/Z", float),
    ),
    ForceChannel: (Field("id", "@id"), Field("unit", "Unit"), Field("label", "Label")),
    ParametersEvents: (Field("events", "Event*", EventDefinition),),
    EventDefinition: (*_ID_LABEL_DESCRIPTION, Field("parameters", "Params/Param*", EventParameter)),
    EventParameter: (
        Field("id", "@id"),
        Field("type", "Type"),
        Field("description", "Description"),
        Field("expected_values", "ExpValues/ExpValue*", ExpectedValue),
    ),
    ExpectedValue: (
        Field("id", "@id"),
        Field("value", "Value"),
        Field("label", "Label"),
        Field("description", "Description"),
    ),
}


def _child_and_parent_tags(kind: type, tag: str) -> Iterator[tuple[str, str]]:
    """Yield (tag, parent's tag) of every element below an element ``tag`` that holds a ``kind``."""
    for field in LAYOUT[kind]:
        parent = tag
        for step in field.path.replace("*", "").split("/"):
            if step != "@id":
                yield step, parent
                parent = step
        if field.kind in LAYOUT:
            yield from _child_and_parent_tags(field.kind, parent)


_TAG_PAIRS: Final = frozenset(_child_and_parent_tags(Parameters, ROOT))

PARENT_TAGS: Final = {tag: {parent for child, parent in _TAG_PAIRS if child == tag} for tag, _ in _TAG_PAIRS}
"""The tags of the elements in which each element of §6 may be."""

TAGS: Final = {tag.lower(): tag for tag in (ROOT, *PARENT_TAGS)}
"""The tags of §6 by their lower-case form."""


class Section(NamedTuple):
    """The names of one section of the parameters."""

    command_word: str
    """The name in SendParameters (§5.3.3)."""
    field: str
    """The field of Parameters."""
    items_field: str = ""
    """The field with the items in the section; "" if it has none."""

    def of(self, parameters: Parameters) -> Any:
        """Return this section of ``parameters``, for example a Parameters3D; None if it is absent."""
        return getattr(parameters, self.field)

    def items_of(self, parameters: Parameters) -> tuple[Any, ...]:
        """Return the markers, tools, channels, plates or events; () if ``parameters`` lack them."""
        return getattr(self.of(parameters), self.items_field, ())


SECTIONS: Final = {
    "general": Section("General", "general"),
    "3d": Section("3D", "markers", "markers"),
    "6d": Section("6D", "tools", "tools"),
    "analog": Section("Analog", "analog", "channels"),
    "force": Section("Force", "force", "plates"),
    "events": Section("Events", "events", "events"),
}
"""The sections of §6 by the names that they have in the gateway's keys, messages and commands."""


def sections_of(parameters: Parameters) -> frozenset[str]:
    """Return the keys in SECTIONS of the sections that ``parameters`` has."""
    return frozenset(key for key, section in SECTIONS.items() if section.of(parameters) is not None)


def only_sections(parameters: Parameters, sections: Collection[str]) -> Parameters:
    """Return the parameters with only these sections (keys of SECTIONS); an empty collection means all."""
    if not sections:
        return parameters
    omitted = {section.field: None for key, section in SECTIONS.items() if key not in sections}
    return replace(parameters, **omitted)


def without_statistics(parameters: Parameters) -> Parameters:
    """Return the parameters without the server's statistics (§6.1), which differ in every reply."""
    if parameters.general is None:
        return parameters
    return replace(parameters, general=replace(parameters.general, frames_sent=None, frames_per_s=None))


def relabelled(parameters: Parameters, label_of: Callable[[Marker | Tool], str]) -> Parameters:
    """Return the parameters with other labels of markers and tools."""
    if parameters.markers is not None:
        markers = tuple(replace(each, label=label_of(each)) for each in parameters.markers.markers)
        parameters = replace(parameters, markers=replace(parameters.markers, markers=markers))
    if parameters.tools is not None:
        tools = tuple(replace(each, label=label_of(each)) for each in parameters.tools.tools)
        parameters = replace(parameters, tools=replace(parameters.tools, tools=tools))
    return parameters


_MAX_NAMED: Final = 3
"""How many items with a new name are listed for each section; the others are counted."""


def differ_in_statistics_only(before: bytes, after: bytes) -> bool:
    """Return whether two XML replies are the same except for the statistics of §6.1. Cheap for long XML."""
    parts = ((xml, _statistics(xml)) for xml in (before, after))
    rest_before, rest_after = (xml[: part.start] + xml[part.stop :] for xml, part in parts)
    return rest_before == rest_after


def statistics_xml(xml: bytes) -> bytes:
    """Return the statistics of §6.1 in an XML reply as a reply of their own; b"" if it has none."""
    found = xml[_statistics(xml)]
    return b"<RT_Parameters><General><Server>%b</Server></General></RT_Parameters>" % found if found else b""


def _statistics(xml: bytes) -> slice:
    """Return where the element of the statistics is; an empty slice if there is none."""
    start = xml.find(b"<Stats>")
    end = xml.find(b"</Stats>", start)
    return slice(0, 0) if start < 0 or end < 0 else slice(start, end + len(b"</Stats>"))


def describe_renames(before: Parameters, after: Parameters) -> str:
    """Return which markers and tools have another name than before; "" if none has.

    Data frames have no names: the position of an item decides which name it has (§6.2, §6.3). So items at
    the same position are compared. The text is bounded, and control characters are escaped.
    """
    texts = []
    for key in ("3d", "6d"):
        items = zip(SECTIONS[key].items_of(before), SECTIONS[key].items_of(after), strict=False)
        renamed = [
            f"{quoted(old.label)} to {quoted(new.label)}" for old, new in items if old.label != new.label
        ]
        if renamed:
            rest = f" and {len(renamed) - _MAX_NAMED} more" if len(renamed) > _MAX_NAMED else ""
            texts.append(f"{key} {', '.join(renamed[:_MAX_NAMED])}{rest}")
    return "; ".join(texts)


def changed_sections(before: Parameters, after: Parameters) -> list[str]:
    """Return the sections that differ in more than the statistics and the names of markers and tools."""
    before, after = (relabelled(without_statistics(each), lambda _: "") for each in (before, after))
    return [name for name, section in SECTIONS.items() if section.of(before) != section.of(after)]
