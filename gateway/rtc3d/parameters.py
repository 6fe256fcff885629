"""The parameters of §6 as typed, frozen objects, their layout in XML, and questions about them.

``parameters_xml`` reads and writes them.

A text that the server did not send is "" (or its default in §6, such as mm), a number is None. Ids are the
server's own texts: numbers may start anywhere (field note 9), and an event's id may be hexadecimal.
"""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from math import nan
from typing import Annotated, Any, Final, NamedTuple

from gateway.runtime.safe_text import quoted


class At(NamedTuple):
    """The place of a dataclass's field in XML: ``path`` leads there from the dataclass's element.

    If a step of ``path`` ends in *, the element is repeated and the field is a tuple. @id is the attribute.
    ``kind`` is str, int, float or a dataclass in LAYOUT. If it ``may_be_empty``, an empty text does not
    become the default. Elements that ``come_first`` are written before the others.
    """

    path: str
    kind: type = str
    may_be_empty: bool = False
    comes_first: bool = False


Id = Annotated[str, At("@id")]
Label = Annotated[str, At("Label")]
Description = Annotated[str, At("Description")]
Frequency = Annotated[float | None, At("Frequency", float)]


@dataclass(frozen=True, slots=True)
class General:
    """§6.1: the server and its average streaming performance during a session."""

    name: Annotated[str, At("Server/Name")] = ""
    version: Annotated[str, At("Server/Ver")] = ""
    address: Annotated[str, At("Server/IPadd")] = ""
    port: Annotated[int | None, At("Server/Port", int)] = None
    frames_sent: Annotated[int | None, At("Server/Stats/FramesSent", int)] = None
    frames_per_s: Annotated[float | None, At("Server/Stats/FramesPerSec", float)] = None


@dataclass(frozen=True, slots=True)
class Marker:
    """One marker of §6.2."""

    id: Id
    label: Label = ""
    description: Description = ""


@dataclass(frozen=True, slots=True)
class Parameters3D:
    """§6.2: the markers, in the order of the 3D component."""

    frequency_hz: Frequency = None
    unit: Annotated[str, At("Unit")] = "mm"
    markers: Annotated[tuple[Marker, ...], At("Markers/Marker*", Marker)] = ()


@dataclass(frozen=True, slots=True)
class Tool:
    """One tool of §6.3; ``marker_ids`` are ids of 3D markers, in the order of the tool's definition."""

    id: Id
    label: Label = ""
    description: Description = ""
    marker_ids: Annotated[tuple[str, ...], At("Markers/Marker*/@id")] = ()


@dataclass(frozen=True, slots=True)
class Parameters6D:
    """§6.3: the tools, in the order of the 6D component."""

    frequency_hz: Frequency = None
    tools: Annotated[tuple[Tool, ...], At("Tools/Tool*", Tool)] = ()


@dataclass(frozen=True, slots=True)
class AnalogChannel:
    """One channel of §6.4."""

    id: Id
    label: Label = ""
    description: Description = ""
    unit: Annotated[str, At("Unit", may_be_empty=True)] = "mV"
    frequency_hz: Frequency = None


@dataclass(frozen=True, slots=True)
class ParametersAnalog:
    """§6.4: the channels, in the order of the Analog component."""

    channels: Annotated[tuple[AnalogChannel, ...], At("Channels/Channel*", AnalogChannel)] = ()


@dataclass(frozen=True, slots=True)
class Point:
    """A position of §6.5, in ``unit``; a coordinate that the server did not send is NaN."""

    x: Annotated[float, At("Point/X", float)] = nan
    y: Annotated[float, At("Point/Y", float)] = nan
    z: Annotated[float, At("Point/Z", float)] = nan
    unit: Annotated[str, At("Unit", comes_first=True)] = "mm"


@dataclass(frozen=True, slots=True)
class ForceChannel:
    """One force or moment channel of a plate (§6.5)."""

    id: Id
    label: Label = ""
    unit: Annotated[str, At("Unit", comes_first=True)] = ""


@dataclass(frozen=True, slots=True)
class Plate:
    """One force plate of §6.5.

    ``corners`` are the plate's four corners in the laboratory, ``origin`` the transducer's origin.
    ``analog_channel_ids`` are ids of the raw analog channels. ``calibration_matrix`` is a tuple of rows;
    a cell that cannot be read is NaN.
    """

    id: Id
    label: Label = ""
    frequency_hz: Annotated[float | None, At("Frequency", float, comes_first=True)] = None
    corners: Annotated[tuple[Point, ...], At("Location/Corner*", Point)] = ()
    origin: Annotated[Point | None, At("Origin", Point)] = None
    channels: Annotated[tuple[ForceChannel, ...], At("Channels/Channel*", ForceChannel)] = ()
    analog_channel_ids: Annotated[tuple[str, ...], At("AnalogChannels/Channel*/@id")] = ()
    excitation_voltage_v: Annotated[float | None, At("ExcitationVoltage", float)] = None
    amplifier_gain: Annotated[float | None, At("AmplifierGain", float)] = None
    calibration_unit: Annotated[str, At("Calibration_Matrix/Unit")] = ""
    calibration_matrix: Annotated[
        tuple[tuple[float, ...], ...], At("Calibration_Matrix/Row*/Col*", float)
    ] = ()


@dataclass(frozen=True, slots=True)
class ParametersForce:
    """§6.5: the plates, in the order of the Force component."""

    plates: Annotated[tuple[Plate, ...], At("Plates/Plate*", Plate)] = ()


@dataclass(frozen=True, slots=True)
class ExpectedValue:
    """One of the values that an event's parameter can have (§6.6)."""

    id: Id
    value: Annotated[str, At("Value")] = ""
    label: Label = ""
    description: Description = ""


@dataclass(frozen=True, slots=True)
class EventParameter:
    """One of up to three parameters of an event (§6.6); ``type`` is int, float or string (4 characters)."""

    id: Id
    type: Annotated[str, At("Type")] = "int"
    description: Description = ""
    expected_values: Annotated[tuple[ExpectedValue, ...], At("ExpValues/ExpValue*", ExpectedValue)] = ()


@dataclass(frozen=True, slots=True)
class EventDefinition:
    """One kind of event of §6.6; ``id`` is the server's text, decimal or 0x…."""

    id: Id
    label: Label = ""
    description: Description = ""
    parameters: Annotated[tuple[EventParameter, ...], At("Params/Param*", EventParameter)] = ()


@dataclass(frozen=True, slots=True)
class ParametersEvents:
    """§6.6: the events that the server is ready to send."""

    events: Annotated[tuple[EventDefinition, ...], At("Event*", EventDefinition)] = ()


@dataclass(frozen=True, slots=True)
class Parameters:
    """The content of one XML reply; a section that it lacks is None. SECTIONS below lists the sections."""

    general: Annotated[General | None, At("General", General)] = None
    markers: Annotated[Parameters3D | None, At("The_3D", Parameters3D)] = None
    tools: Annotated[Parameters6D | None, At("The_6D", Parameters6D)] = None
    analog: Annotated[ParametersAnalog | None, At("Analog", ParametersAnalog)] = None
    force: Annotated[ParametersForce | None, At("Force", ParametersForce)] = None
    events: Annotated[ParametersEvents | None, At("Events", ParametersEvents)] = None

    @property
    def length_unit(self) -> str:
        """The unit of all positions, also of tools: that of the 3D section, and its default without one."""
        return (self.markers or Parameters3D()).unit


ROOT: Final = "RT_Parameters"


def _places(dataclass: type) -> dict[str, At]:
    places = {name: annotated.__metadata__[0] for name, annotated in dataclass.__annotations__.items()}
    return dict(sorted(places.items(), key=lambda item: not item[1].comes_first))


LAYOUT: Final[dict[type, dict[str, At]]] = {
    dataclass: _places(dataclass)
    for dataclass in (
        *(Parameters, General, Parameters3D, Marker, Parameters6D, Tool, ParametersAnalog, AnalogChannel),
        *(ParametersForce, Plate, Point, ForceChannel),
        *(ParametersEvents, EventDefinition, EventParameter, ExpectedValue),
    )
}
"""The place of each field of each dataclass in XML, in the order in which they are written."""


def _child_and_parent_tags(kind: type, tag: str) -> Iterator[tuple[str, str]]:
    """Yield (tag, parent's tag) of every element below an element ``tag`` that holds a ``kind``."""
    for at in LAYOUT[kind].values():
        parent = tag
        for step in at.path.replace("*", "").split("/"):
            if step != "@id":
                yield step, parent
                parent = step
        if at.kind in LAYOUT:
            yield from _child_and_parent_tags(at.kind, parent)


_TAG_PAIRS: Final = frozenset(_child_and_parent_tags(Parameters, ROOT))

PARENT_TAGS: Final = {tag: {parent for child, parent in _TAG_PAIRS if child == tag} for tag, _ in _TAG_PAIRS}
"""The tags of the elements in which each element of §6 may be."""

TAGS: Final = {tag.lower(): tag for tag in (ROOT, *PARENT_TAGS)}
"""The tags of §6 by their lower-case form."""


class SectionNames(NamedTuple):
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
    "general": SectionNames("General", "general"),
    "3d": SectionNames("3D", "markers", "markers"),
    "6d": SectionNames("6D", "tools", "tools"),
    "analog": SectionNames("Analog", "analog", "channels"),
    "force": SectionNames("Force", "force", "plates"),
    "events": SectionNames("Events", "events", "events"),
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
