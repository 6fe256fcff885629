"""The XML layout of the parameters (§6): which element or attribute holds each field.

The reader, the writer and the repair of XML all use this table.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    EventParameter,
    ExpectedValue,
    ForceChannel,
    General,
    Marker,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersEvents,
    ParametersForce,
    Plate,
    Point,
    Tool,
)

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
