"""XML parameters (§6): parsing them liberally into the typed objects of ``parameters``, and encoding them."""

import math
import re
from collections.abc import Collection
from itertools import islice
from operator import itemgetter
from typing import Any, Final, NamedTuple

from lxml import etree

from gateway.errors import ParametersError
from gateway.rtc3d.parameters import LAYOUT, PARENT_TAGS, ROOT, SECTIONS, TAGS, Parameters, only_sections
from gateway.runtime.safe_text import quoted, safe_text

MAX_XML_BYTES: Final = 1024 * 1024
"""Larger documents are not parsed. This is enough for about 8000 markers; parsing takes 1.4 s at worst."""
MAX_ITEMS: Final = 10_000
"""The highest number of markers, tools, channels, plates and the like in one list."""
MAX_TEXT_CHARACTERS: Final = 1000
"""Longer texts are cut: labels go into log messages and into the names of topics."""
MAX_RECOVERED: Final = 20
"""The highest number of entries in ``ParsedParameters.recovered``."""
_PADDING: Final = b"\0 \t\r\n"
"""Bytes at both ends of an XML reply that are ignored (field note 9)."""
_SECTION_TAGS: Final = {name: at.path for name, at in LAYOUT[Parameters].items()}
_MAX_NOTE_CHARACTERS: Final = 200
_MAX_QUOTED_BYTES: Final = 60

# Each stray end tag makes libxml2 close one element too many. Once it closes the root, it drops the rest.
# This many extra roots around a malformed document prevent that (libxml2 allows a depth of 256).
_EXTRA_ROOTS: Final = 64
# After its first error libxml2 drops every named entity, even &amp;, but no numeric character reference.
_AMPERSAND: Final = re.compile(rb"&(?:amp;|lt;|gt;|quot;|apos;|(?!#\d+;|#x[\da-fA-F]+;))")
_NUMERIC_REFERENCES: Final = {
    b"&": b"&#38;",
    b"&amp;": b"&#38;",
    b"&lt;": b"&#60;",
    b"&gt;": b"&#62;",
    b"&quot;": b"&#34;",
    b"&apos;": b"&#39;",
}
_SECTION_ENDS: Final = (b">", b" ", b"/", b"\t", b"\r", b"\n")
"""What follows the name of an element."""
_NOT_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


class ParsedParameters(NamedTuple):
    """The content of an XML reply, and ``recovered``: a line for each fault that was repaired or skipped."""

    parameters: Parameters
    recovered: tuple[str, ...]


def parse_parameters(xml: bytes) -> ParsedParameters:
    """Return the parameters in the body of an XML packet (type 2).

    Parses liberally (field note 9): unknown elements and text between elements are ignored, sections may
    be absent, NULs at the end and white space around texts are dropped, and the case of tags is ignored.
    A field that is absent or cannot be read gets its default; a cell of a calibration matrix gets NaN. An
    analog channel with an empty unit has none. XML that is not well-formed, such as the specification's own
    examples in §6.5 and §6.6, is repaired as a human would read it. ``recovered`` has a line for each fault,
    up to MAX_RECOVERED. Items after the first MAX_ITEMS of a list, and texts after MAX_TEXT_CHARACTERS, are
    left out.

    Raises ParametersError, and nothing else, if the XML has no parameters, declares entities, or is larger
    than MAX_XML_BYTES.
    """
    body = xml.strip(_PADDING)
    if len(body) > MAX_XML_BYTES:
        raise ParametersError(
            f"the server's parameters take {len(body)} bytes, above the limit of {MAX_XML_BYTES}: "
            "this is not an RTC3D server, or it is faulty; check host and port"
        )
    # Entities are never resolved (see _parse), so texts that contain them would be incomplete.
    if b"<!ENTITY" in body:
        raise ParametersError(
            "the server's parameters declare XML entities, which RTC3D does not have, so they are not read; "
            "check host and port"
        )
    notes: list[str] = []
    tree = _parse_tree(body, notes)
    return ParsedParameters(_read(Parameters, tree, notes), tuple(notes))


def extract_sections(xml: bytes, sections: Collection[str]) -> bytes | None:
    """Return the elements of ``sections`` (keys of SECTIONS) in an XML reply, below the reply's root element.

    They have everything that the server wrote in them, also what §6 does not define, but comments are left
    out, and the result is in ASCII. Returns None if the XML lacks one of the sections or is not well-formed.
    """
    body = xml.strip(_PADDING)
    if len(body) > MAX_XML_BYTES or b"<!ENTITY" in body:
        return None
    root, errors = _parse(body, None if _is_utf8(body) else "iso-8859-1")
    if root is None or errors or _tag(root) != ROOT:
        return None
    tags = {_SECTION_TAGS[SECTIONS[section].field] for section in sections}
    if not tags <= {_tag(element) for element in root}:
        return None
    for element in list(root):
        if _tag(element) not in tags:
            root.remove(element)
    return etree.tostring(root)


def cut_sections(xml: bytes, parsed: Parameters, sections: Collection[str]) -> bytes:
    """Return some sections (keys of SECTIONS) of a server's reply, which has been ``parsed``, as XML.

    For all, and for none, it is the reply itself. If XML that is not well-formed has to be cut, what was read
    is written again.
    """
    if not sections or SECTIONS.keys() <= set(sections):
        return xml
    extracted = extract_sections(xml, sections)
    return encode_parameters(only_sections(parsed, sections)) if extracted is None else extracted


def named_sections(xml: bytes) -> frozenset[str]:
    """Return the sections (keys of SECTIONS) whose elements seem to be in an XML reply, without parsing it.

    It takes some milliseconds at worst. In damaged or hostile XML, the answer may be wrong.
    """
    begin = xml[:MAX_XML_BYTES].lower()
    return frozenset(
        key
        for key, section in SECTIONS.items()
        if any(
            b"<%b%b" % (_SECTION_TAGS[section.field].lower().encode(), end) in begin for end in _SECTION_ENDS
        )
    )


def _parse_tree(body: bytes, notes: list[str]) -> etree._Element:
    """Return the elements of §6 in ``body`` as a tree below RT_Parameters; raises ParametersError."""
    encoding = None  # the declared encoding, otherwise UTF-8
    root, errors = _parse(body, encoding)
    if errors and not _is_utf8(body):
        encoding = "iso-8859-1"
        _note(notes, "bytes that are not UTF-8 were read as Latin-1")
        root, errors = _parse(body, encoding)
    is_parameters = root is not None and _tag(root) == ROOT
    if errors:
        for error in errors:
            _note(notes, error)
        content = _AMPERSAND.sub(lambda found: _NUMERIC_REFERENCES[found[0]], body)
        root, _ = _parse(b"<%b>" % ROOT.encode() * _EXTRA_ROOTS + content, encoding)
    elif not is_parameters:
        _note(notes, f"the root element is not {ROOT}")
    tree = etree.Element(ROOT)
    if root is not None:
        _copy_elements(root, tree, repair=bool(errors) or not is_parameters)
    if not is_parameters and len(tree) == 0:
        begin = body[: _MAX_QUOTED_BYTES + 1].decode("latin-1")
        raise ParametersError(
            f"the server's XML has no parameters but begins with {quoted(begin, _MAX_QUOTED_BYTES)}; "
            "check host and port, and that this is an RTC3D server"
        )
    return tree


def _is_utf8(body: bytes) -> bool:
    try:
        body.decode()
    except UnicodeDecodeError:
        return False
    return True


def _parse(body: bytes, encoding: str | None) -> tuple[etree._Element | None, list[str]]:
    """Return the root element (None if there is none) and a line for each error, up to MAX_RECOVERED."""
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
    errors = islice(parser.error_log.filter_from_errors(), MAX_RECOVERED)
    return root, [f"line {error.line}: {error.message.strip()}" for error in errors]


def _tag(element: etree._Element) -> str | None:
    """Return the element's tag in the spelling of §6; None if §6 does not define it."""
    return TAGS.get(element.tag.rpartition("}")[2].lower())


def _copy_elements(root: etree._Element, tree: etree._Element, *, repair: bool) -> None:
    """Copy the elements of §6 below ``root`` into ``tree``, in document order, with parents as in §6.

    After a missing or stray end tag, all further elements are nested wrongly. An element whose parent cannot
    contain it by §6 is skipped or, with ``repair``, moved to the last element before it that can contain it.
    """
    copies: dict[etree._Element | None, etree._Element] = {root: tree}
    latest: dict[str, tuple[int, etree._Element]] = {ROOT: (0, tree)}
    for position, element in enumerate(root.iter("*"), start=1):
        tag = _tag(element)
        if tag is None:
            continue
        if tag == ROOT:
            copies[element] = tree
            continue
        parent = copies.get(element.getparent())
        if parent is None or parent.tag not in PARENT_TAGS[tag]:
            candidates = [latest[parent_tag] for parent_tag in PARENT_TAGS[tag] if parent_tag in latest]
            if not repair or not candidates:
                continue
            _, parent = max(candidates, key=itemgetter(0))
        copies[element] = copy = etree.SubElement(parent, tag)
        try:
            text, element_id = element.text or "", element.get("id") or element.get("ID") or ""
        except UnicodeDecodeError:  # libxml2 keeps what &#xD800; refers to if the XML is malformed
            text = element_id = ""
        # Depending on its version, libxml2 may keep characters that lxml then refuses.
        copy.text = _xml_text(text)
        copy.set("id", _xml_text(element_id))
        latest[tag] = (position, copy)


def _read(kind: type, element: etree._Element, notes: list[str]) -> Any:
    """Return the dataclass ``kind`` that ``element`` describes; absent fields have their defaults."""
    values = {name: _value(element, at.path, at.kind, notes) for name, at in LAYOUT[kind].items()}
    for name, at in LAYOUT[kind].items():
        if at.may_be_empty and values[name] is None and element.find(at.path) is not None:
            values[name] = ""
    return kind(**{name: value for name, value in values.items() if value is not None})


def _value(element: etree._Element, path: str, kind: type, notes: list[str]) -> Any:
    """Return the value at ``path`` below ``element``; None if it is absent or cannot be read."""
    head, star, rest = path.partition("*")
    if star:
        found_items = list(islice(element.iterfind(head), MAX_ITEMS + 1 if kind in LAYOUT else None))
        if kind in LAYOUT and len(found_items) > MAX_ITEMS:
            _note(notes, f"more than {MAX_ITEMS} elements {head}: the others are left out")
            del found_items[MAX_ITEMS]
        items = (_value(item, rest.removeprefix("/"), kind, notes) for item in found_items)
        # Only a number can be None here; NaN takes its place in the row.
        return tuple(math.nan if item is None else item for item in items)
    if path == "@id":
        return _cut(element.get("id", "").strip(), notes)
    found = element.find(path) if path else element
    if found is None:
        return None
    if kind in LAYOUT:
        return _read(kind, found, notes)
    text = (found.text or "").strip()
    return (_cut(text, notes) or None) if kind is str else _number(found, text, kind, notes)


def _cut(text: str, notes: list[str]) -> str:
    if len(text) > MAX_TEXT_CHARACTERS:
        _note(notes, f"a text of {len(text)} characters is cut to {MAX_TEXT_CHARACTERS}")
    return text[:MAX_TEXT_CHARACTERS]


def _number(element: etree._Element, text: str, kind: type, notes: list[str]) -> Any:
    """Return ``text`` as a finite int or float; None if it is neither."""
    if not text:
        return None
    try:
        number = kind(text)
        if math.isfinite(number):
            return number
    except (ValueError, OverflowError):
        pass
    if len(notes) < MAX_RECOVERED:  # getpath is slow among many siblings
        path = element.getroottree().getpath(element).removeprefix(f"/{ROOT}/")
        _note(notes, f"{path} {quoted(text)} is not a number")
    return None


def encode_parameters(parameters: Parameters) -> bytes:
    """Return the XML of the sections that are not None, in §6's layout and in ASCII (§4.2).

    Leaves out characters that XML cannot represent, and numbers that are None.
    """
    root = etree.Element(ROOT, Ver="1.00")
    _write(parameters, root, "")
    return etree.tostring(root, pretty_print=True)


def _write(value: Any, element: etree._Element, path: str) -> None:
    if value is None:
        return
    head, star, rest = path.partition("*")
    if star:
        container, _, tag = head.rpartition("/")
        parent = _descend(element, container)
        for number, item in enumerate(value, start=1):
            # Every repeated element of §6 is numbered; an id in the dataclass replaces the number.
            _write(item, etree.SubElement(parent, tag, id=str(number)), rest.removeprefix("/"))
    elif path == "@id":
        element.set("id", _xml_text(value))
    elif type(value) in LAYOUT:
        parent = _descend(element, path)
        for name, at in LAYOUT[type(value)].items():
            _write(getattr(value, name), parent, at.path)
    else:
        _descend(element, path).text = _xml_text(str(value))


def _descend(element: etree._Element, path: str) -> etree._Element:
    """Return the element at ``path`` below ``element``; create it if it does not exist."""
    for tag in path.split("/") if path else ():
        child = element.find(tag)
        element = etree.SubElement(element, tag) if child is None else child
    return element


def _xml_text(text: str) -> str:
    return _NOT_XML.sub("", text)


def _note(notes: list[str], note: str) -> None:
    if len(notes) < MAX_RECOVERED:
        notes.append(safe_text(note, _MAX_NOTE_CHARACTERS))
