"""XML parameters (§6): read liberally into the typed objects of ``parameters``, and written in §6's layout.

One table, _LAYOUT, says where each field stands in the XML. The reader, the writer and the repair of
malformed documents all go by it.
"""

import math
import re
from collections.abc import Iterator
from operator import itemgetter
from typing import Any, Final, NamedTuple

from lxml import etree

from gateway.errors import ParametersError
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

MAX_XML_BYTES: Final = 1024 * 1024
"""More than this is not parsed: it would name some 8000 markers, and take seconds at worst."""
MAX_RECOVERED: Final = 20
"""How many entries ``ParsedParameters.recovered`` has at most."""

_ROOT: Final = "RT_Parameters"
# A stray end tag makes libxml2 close one element too many, at last the root, and drop what follows.
# That many further roots around a malformed document keep it (libxml2 allows a depth of 256).
_SPARE_ROOTS: Final = 64
# After its first error libxml2 drops every entity, &amp; too, but no character by number.
_AMPERSAND: Final = re.compile(rb"&(?:amp;|lt;|gt;|quot;|apos;|(?!#\d+;|#x[\da-fA-F]+;))")
_BY_NUMBER: Final = {
    b"&": b"&#38;",
    b"&amp;": b"&#38;",
    b"&lt;": b"&#60;",
    b"&gt;": b"&#62;",
    b"&quot;": b"&#34;",
    b"&apos;": b"&#39;",
}
_NOT_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


class ParsedParameters(NamedTuple):
    """What an XML reply held, and one line for each thing that had to be recovered or left out."""

    parameters: Parameters
    recovered: tuple[str, ...]


class _Field(NamedTuple):
    """Where a dataclass's field stands below the dataclass's element.

    In ``path``, a step that ends in * is repeated and makes a tuple; @id is the attribute.
    ``kind`` is str, int, float or a dataclass of _LAYOUT.
    """

    name: str
    path: str
    kind: type = str


_NAMED: Final = (_Field("id", "@id"), _Field("label", "Label"), _Field("description", "Description"))
_LAYOUT: Final[dict[type, tuple[_Field, ...]]] = {
    Parameters: (
        _Field("general", "General", General),
        _Field("markers", "The_3D", Parameters3D),
        _Field("tools", "The_6D", Parameters6D),
        _Field("analog", "Analog", ParametersAnalog),
        _Field("force", "Force", ParametersForce),
        _Field("events", "Events", ParametersEvents),
    ),
    General: (
        _Field("name", "Server/Name"),
        _Field("version", "Server/Ver"),
        _Field("address", "Server/IPadd"),
        _Field("port", "Server/Port", int),
        _Field("frames_sent", "Server/Stats/FramesSent", int),
        _Field("frames_per_s", "Server/Stats/FramesPerSec", float),
    ),
    Parameters3D: (
        _Field("frequency_hz", "Frequency", float),
        _Field("unit", "Unit"),
        _Field("markers", "Markers/Marker*", Marker),
    ),
    Marker: _NAMED,
    Parameters6D: (
        _Field("frequency_hz", "Frequency", float),
        _Field("tools", "Tools/Tool*", Tool),
    ),
    Tool: (*_NAMED, _Field("marker_ids", "Markers/Marker*/@id")),
    ParametersAnalog: (_Field("channels", "Channels/Channel*", AnalogChannel),),
    AnalogChannel: (*_NAMED, _Field("unit", "Unit"), _Field("frequency_hz", "Frequency", float)),
    ParametersForce: (_Field("plates", "Plates/Plate*", Plate),),
    Plate: (
        _Field("id", "@id"),
        _Field("frequency_hz", "Frequency", float),
        _Field("label", "Label"),
        _Field("corners", "Location/Corner*", Point),
        _Field("origin", "Origin", Point),
        _Field("channels", "Channels/Channel*", ForceChannel),
        _Field("analog_channel_ids", "AnalogChannels/Channel*/@id"),
        _Field("excitation_voltage_v", "ExcitationVoltage", float),
        _Field("amplifier_gain", "AmplifierGain", float),
        _Field("calibration_unit", "Calibration_Matrix/Unit"),
        _Field("calibration_matrix", "Calibration_Matrix/Row*/Col*", float),
    ),
    Point: (
        _Field("unit", "Unit"),
        _Field("x", "Point/X", float),
        _Field("y", "Point/Y", float),
        _Field("z", "Point/Z", float),
    ),
    ForceChannel: (_Field("id", "@id"), _Field("unit", "Unit"), _Field("label", "Label")),
    ParametersEvents: (_Field("events", "Event*", EventDefinition),),
    EventDefinition: (*_NAMED, _Field("parameters", "Params/Param*", EventParameter)),
    EventParameter: (
        _Field("id", "@id"),
        _Field("type", "Type"),
        _Field("description", "Description"),
        _Field("expected_values", "ExpValues/ExpValue*", ExpectedValue),
    ),
    ExpectedValue: (
        _Field("id", "@id"),
        _Field("value", "Value"),
        _Field("label", "Label"),
        _Field("description", "Description"),
    ),
}


def _child_and_parent_tags(kind: type, tag: str) -> Iterator[tuple[str, str]]:
    """Yield each element of §6 with the element it stands in, for ``kind`` in an element ``tag``."""
    for field in _LAYOUT[kind]:
        parent = tag
        for step in field.path.replace("*", "").split("/"):
            if step != "@id":
                yield step, parent
                parent = step
        if field.kind in _LAYOUT:
            yield from _child_and_parent_tags(field.kind, parent)


_PAIRS: Final = frozenset(_child_and_parent_tags(Parameters, _ROOT))
_PARENTS: Final = {tag: {parent for child, parent in _PAIRS if child == tag} for tag, _ in _PAIRS}
_TAGS: Final = {tag.lower(): tag for tag in (_ROOT, *_PARENTS)}


def parse_parameters(xml: bytes) -> ParsedParameters:
    """Return what the body of an XML packet (type 2) holds of §6.

    Read liberally (field note 9): unknown elements and text between elements are ignored, sections
    may be absent, NULs at the end and white space around texts are dropped, the case of tags does not
    count. What is absent or cannot be read gets its field's default, a cell of a calibration matrix
    NaN. XML that is not well-formed, as the specification's own examples of §6.5 and §6.6, is read as
    a human reads it. ``recovered`` has a line for each fault found, at most MAX_RECOVERED.

    Raises ParametersError, and nothing else, if no parameters can be found, if the XML declares
    entities, or if it is larger than MAX_XML_BYTES.
    """
    body = xml.strip(b"\0 \t\r\n")
    if len(body) > MAX_XML_BYTES:
        raise ParametersError(
            f"the server's parameters take {len(body)} bytes, above the limit of {MAX_XML_BYTES}: "
            "this is no RTC3D server, or it is faulty; check host and port"
        )
    # Nothing would be expanded without bound (libxml2 sees to that), but texts would be incomplete.
    if b"<!ENTITY" in body:
        raise ParametersError(
            "the server's parameters declare XML entities, which RTC3D does not have; they are not read. "
            "Check host and port"
        )
    notes: list[str] = []
    tree = _tree(body, notes)
    return ParsedParameters(_read(Parameters, tree, notes), tuple(notes))


def _tree(body: bytes, notes: list[str]) -> etree._Element:
    """Return the elements of §6 in ``body``, under a root RT_Parameters."""
    encoding = None  # as declared, else UTF-8
    root, errors = _parse(body, encoding)
    if errors and not _is_utf8(body):
        encoding = "iso-8859-1"
        _note(notes, "bytes that are not UTF-8 were read as Latin-1")
        root, errors = _parse(body, encoding)
    is_parameters = root is not None and _tag(root) == _ROOT
    if errors:
        for error in errors:
            _note(notes, error)
        content = _AMPERSAND.sub(lambda found: _BY_NUMBER[found[0]], body)
        root, _ = _parse(b"<%b>" % _ROOT.encode() * _SPARE_ROOTS + content, encoding)
    elif not is_parameters:
        _note(notes, f"the root element is not {_ROOT}")
    tree = etree.Element(_ROOT)
    if root is not None:
        _hang(root, tree, rehang=bool(errors) or not is_parameters)
    if not is_parameters and len(tree) == 0:
        raise ParametersError(
            "what the server sent as parameters holds none: it begins with "
            f"{_shown(body.decode('latin-1'))}; check host and port, and that this is an RTC3D server"
        )
    return tree


def _is_utf8(body: bytes) -> bool:
    try:
        body.decode()
    except UnicodeDecodeError:
        return False
    return True


def _parse(body: bytes, encoding: str | None) -> tuple[etree._Element | None, list[str]]:
    """Return the root element, None if there is none, and what is wrong with the XML."""
    parser = etree.XMLParser(
        encoding=encoding,
        recover=True,
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        huge_tree=False,
        remove_comments=True,
        remove_pis=True,
    )
    try:
        root = etree.fromstring(body, parser)
    except etree.XMLSyntaxError:
        root = None
    errors = parser.error_log.filter_from_errors()
    return root, [f"line {error.line}: {error.message.strip()}" for error in errors]


def _tag(element: etree._Element) -> str | None:
    """Return the element's tag as §6 spells it, None if §6 does not know it."""
    return _TAGS.get(element.tag.rpartition("}")[2].lower())


def _hang(root: etree._Element, tree: etree._Element, *, rehang: bool) -> None:
    """Hang the elements of §6 under ``root`` into ``tree``, in document order, each where §6 has it.

    With ``rehang`` one whose parent cannot have it goes to the last element before it that can: where
    an end tag is missing or stray, all that follows is nested wrongly. Without, it is left out.
    """
    placed: dict[etree._Element | None, etree._Element] = {root: tree}
    latest: dict[str, tuple[int, etree._Element]] = {_ROOT: (0, tree)}
    for position, element in enumerate(root.iter("*"), start=1):
        tag = _tag(element)
        if tag is None:
            continue
        if tag == _ROOT:
            placed[element] = tree
            continue
        parent = placed.get(element.getparent())
        if parent is None or parent.tag not in _PARENTS[tag]:
            able = [latest[parent_tag] for parent_tag in _PARENTS[tag] if parent_tag in latest]
            if not rehang or not able:
                continue
            _, parent = max(able, key=itemgetter(0))
        placed[element] = hung = etree.SubElement(parent, tag)
        # Recovery may keep characters that lxml then refuses, depending on libxml2's version.
        hung.text = _xml_text(element.text or "")
        hung.set("id", _xml_text(element.get("id") or element.get("ID") or ""))
        latest[tag] = (position, hung)


def _read(kind: type, element: etree._Element, notes: list[str]) -> Any:
    """Return the ``kind`` that ``element`` describes; what is absent keeps the dataclass's default."""
    values = {field.name: _value(element, field.path, field.kind, notes) for field in _LAYOUT[kind]}
    return kind(**{name: value for name, value in values.items() if value is not None})


def _value(element: etree._Element, path: str, kind: type, notes: list[str]) -> Any:
    """Return what stands at ``path`` below ``element``, None if it is absent or cannot be read."""
    head, star, rest = path.partition("*")
    if star:
        items = (_value(item, rest.removeprefix("/"), kind, notes) for item in element.iterfind(head))
        # Only a number can be None here; its place in the row is kept.
        return tuple(math.nan if item is None else item for item in items)
    if path == "@id":
        return element.get("id", "").strip()
    found = element.find(path) if path else element
    if found is None:
        return None
    if kind in _LAYOUT:
        return _read(kind, found, notes)
    text = (found.text or "").strip()
    return (text or None) if kind is str else _number(found, text, kind, notes)


def _number(element: etree._Element, text: str, kind: type, notes: list[str]) -> Any:
    if not text:
        return None
    try:
        number = kind(text)
        if math.isfinite(number):
            return number
    except (ValueError, OverflowError):
        pass
    if len(notes) < MAX_RECOVERED:  # getpath takes long among many siblings
        place = element.getroottree().getpath(element).removeprefix(f"/{_ROOT}/")
        _note(notes, f"{place} {_shown(text)} is not a number")
    return None


def encode_parameters(parameters: Parameters) -> bytes:
    """Return the XML of the sections that are not None, in §6's layout and in ASCII (§4.2).

    Characters that XML cannot hold are dropped, and numbers that are None are left out.
    """
    root = etree.Element(_ROOT, Ver="1.00")
    _write(parameters, root)
    return etree.tostring(root, pretty_print=True)


def _write(described: object, element: etree._Element) -> None:
    for field in _LAYOUT[type(described)]:
        _write_value(getattr(described, field.name), element, field.path)


def _write_value(value: Any, element: etree._Element, path: str) -> None:
    if value is None:
        return
    head, star, rest = path.partition("*")
    if star:
        container, _, tag = head.rpartition("/")
        parent = _descend(element, container)
        for number, item in enumerate(value, start=1):
            # Everything that §6 repeats is numbered; an id of its own replaces the number.
            _write_value(item, etree.SubElement(parent, tag, id=str(number)), rest.removeprefix("/"))
    elif path == "@id":
        element.set("id", _xml_text(value))
    elif type(value) in _LAYOUT:
        _write(value, _descend(element, path))
    else:
        _descend(element, path).text = _xml_text(str(value))


def _descend(element: etree._Element, path: str) -> etree._Element:
    """Return the element at ``path`` below ``element``, made where it is not there yet."""
    for tag in path.split("/") if path else ():
        child = element.find(tag)
        element = etree.SubElement(element, tag) if child is None else child
    return element


def _xml_text(text: str) -> str:
    return _NOT_XML.sub("", text)


def _shown(text: str) -> str:
    """Return a text from the server fit for a message: bounded, printable."""
    return ascii(text) if len(text) <= 60 else ascii(text[:60]) + "…"


def _note(notes: list[str], note: str) -> None:
    if len(notes) < MAX_RECOVERED:
        notes.append(note[:200])
