"""Parameters (§6): the specification's examples, faults of servers, attacks on the parser, and encoding."""

import math
import re
from collections import Counter
from pathlib import Path

import pytest
from lxml import etree

from gateway.errors import ParametersError
from gateway.rtc3d.parameters import (
    SECTIONS,
    AnalogChannel,
    EventDefinition,
    EventParameter,
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
from gateway.rtc3d.parameters_xml import (
    MAX_ITEMS,
    MAX_RECOVERED,
    MAX_TEXT_CHARACTERS,
    MAX_XML_BYTES,
    encode_parameters,
    extract_sections,
    named_sections,
    parse_parameters,
)
from tests.support.errors import each_names, names
from tests.support.parameters import ALL, BY_SECTION, MARKERS, in_root, markers_of, spec_body, spec_xml


def recovered_markers(xml: bytes) -> tuple[Parameters3D, tuple[str, ...]]:
    """Return the 3D section of XML that has faults, and the faults."""
    parameters, recovered = parse_parameters(xml)
    assert parameters.markers is not None
    assert recovered
    return parameters.markers, recovered


@pytest.mark.parametrize(
    ("section", "faults"),
    [
        *(("general", []), ("3d", []), ("6d", []), ("analog", [])),
        ("force", [("line 70: ", "Channel")]),  # a stray end tag
        ("events", [("line 13: ", "Description"), ("line 24: ", "Description")]),  # without end tags
    ],
)
def test_the_examples_are_read_with_their_faults(section: str, faults: list[tuple[str, str]]) -> None:
    """The specification's own examples are not all well-formed, and vendors copied them."""
    parameters, recovered = parse_parameters(spec_xml(section))
    assert parameters == BY_SECTION[section]
    assert bool(recovered) is bool(faults)
    for line, tag in faults:
        assert [note for note in recovered if note.startswith(line) and tag in note]
    start = list(SECTIONS).index(section)  # all sections in one document, which begins with this one
    order = [*SECTIONS, *SECTIONS][start : start + len(SECTIONS)]
    xml = b"<RT_Parameters Ver='1.00'>%b</RT_Parameters>" % b"".join(map(spec_body, order))
    assert parse_parameters(xml).parameters == ALL


# Faults ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("section", "unit_ids_and_labels", "fault"),
    [
        (
            "<Markers><Marker id='0'><Label>a</Label><Marker id='1'><Label>b</Label></Markers>",
            "mm 0 a 1 b",
            "line ",
        ),
        ("<Unit>m</Unit><Unit>mm</Unit>", "m", ""),
        (
            "<Markers><Marker id='1'><Label>L&R &lt; &nbsp;</Label></Marker></Markers>",
            "mm 1 L&R < &nbsp;",
            "line ",
        ),
        ("<Unit>m\x01m</Unit><Frequency>\x02&#3;</Frequency>", "mm", "line "),
        ("<Frequency></Frequency><Unit> </Unit>", "mm", ""),
        *(
            (f"<Frequency>{number}</Frequency>", "mm", f"The_3D/Frequency '{number}' is not a number")
            for number in ("abc", "60,0", "nan", "-inf", "1e999", "0x10")
        ),
    ],
)
def test_a_section_is_read_in_spite_of_faults(section: str, unit_ids_and_labels: str, fault: str) -> None:
    parameters, recovered = parse_parameters(in_root(f"<The_3D>{section}</The_3D>"))
    assert parameters.markers is not None
    found = [parameters.markers.unit, *(f"{each.id} {each.label}" for each in parameters.markers.markers)]
    assert (" ".join(found), parameters.markers.frequency_hz) == (unit_ids_and_labels, None)
    assert all(note.startswith(fault) for note in recovered)
    assert bool(recovered) is bool(fault)


def test_a_truncated_document_is_read_in_part_and_reported_or_is_an_error() -> None:
    """A reply that was cut must never pass for a whole one."""
    xml = encode_parameters(ALL).strip()
    whole = xml.index(b"Button was released") + len("Button was released")
    for end in (*range(0, whole - 20, 13), *range(whole - 20, len(xml))):
        try:
            parameters, recovered = parse_parameters(xml[:end])
        except ParametersError:
            assert end < len("<RT_Parameters Ver='1.00'>")
        else:
            assert recovered, xml[:end]
            assert (parameters == ALL) == (end >= whole)


def test_the_report_is_bounded_and_printable() -> None:
    xml = in_root(f"<The_3D><Unit>m\0m</Unit><{'x' * 5000}>{'&' * 5000}</The_3D>")
    recovered = parse_parameters(xml).recovered
    assert len(recovered) == MAX_RECOVERED
    assert all(note.isprintable() and len(note) <= 200 for note in recovered)
    cut = parse_parameters(xml.replace(b"&", b"")).recovered
    assert "x" * 100 in "".join(cut)
    assert max(map(len, cut)) == 200


def test_what_servers_vary_does_not_matter() -> None:
    """Endings, the case of tags and attributes, and a namespace change no value and are no faults."""
    xml = spec_xml("3d")
    lower = re.sub(rb"(</?)(\w+)", lambda tag: tag[1] + tag[2].lower(), xml)
    for variant in (
        *(xml + end for end in (b"\0", b"\0\0\0\n", b"\r\n\0", b" \t\n")),
        *(lower, lower.replace(b"id =", b"ID ="), xml.replace(b" Ver", b" xmlns='ndi' Ver", 1)),
    ):
        assert parse_parameters(variant) == (Parameters(markers=MARKERS), ())
    assert parse_parameters(b"<RT_Parameters Ver='1.00'></RT_Parameters>") == (Parameters(), ())
    assert recovered_markers(b"OK-SendParameters 3D\n" + xml)[0] == MARKERS
    ids = ["0", "7", "7", "-1", "0x123456", "left arm", ""]
    markers = "".join(f"<Marker id = ' {marker_id} '></Marker>" for marker_id in ids)
    xml = in_root(f"<The_3D><Markers>{markers}<Marker/></Markers></The_3D>")
    assert [marker.id for marker in markers_of(xml).markers] == [*ids, ""]


def test_unknown_elements_text_comments_and_order_do_not_matter() -> None:
    xml = in_root(
        "text <Vendor><The_3D><Unit>inch</Unit></The_3D><Label>x</Label></Vendor>",
        "<The_3D><!-- ours --> dots . . . <Markers>, <Marker id='1' colour='red'><Colour/>",
        "<Description>left<!-- side --><?pi?> arm</Description><Label>a</Label></Marker> .</Markers>",
        "<Vendor><Unit>inch</Unit></Vendor><Frequency> 100 </Frequency></The_3D>",
    )
    assert markers_of(xml) == Parameters3D(100.0, "mm", (Marker("1", "a", "left arm"),))


def test_absent_and_empty_values_get_their_defaults() -> None:
    xml = in_root(
        "<General/><Analog><Channels><Channel id='1'/></Channels></Analog>",
        "<Events><Event id='1'><Params><Param id='1'><Type/></Param></Params></Event></Events>",
    )
    parameter = EventParameter("1", "int")
    assert parse_parameters(xml) == (
        Parameters(
            general=General(),
            analog=ParametersAnalog((AnalogChannel("1", unit="mV"),)),
            events=ParametersEvents((EventDefinition("1", parameters=(parameter,)),)),
        ),
        (),
    )


def test_an_analog_channel_with_an_empty_unit_has_none() -> None:
    """The unit of a channel can be unknown, and mV would be wrong by 1000 for one in V."""
    xml = encode_parameters(Parameters(analog=ParametersAnalog((AnalogChannel("1", unit=""),))))
    analog = parse_parameters(xml).parameters.analog
    assert analog is not None
    assert analog.channels[0].unit == ""


@pytest.mark.parametrize("number", ["3020.0", "9" * 400, "9" * 5000])
def test_a_port_that_is_not_a_whole_number_is_none_and_reported(number: str) -> None:
    parameters, [note] = parse_parameters(
        in_root(f"<General><Server><Port>{number}</Port></Server></General>")
    )
    assert parameters == Parameters(general=General())
    assert note.startswith(f"General/Server/Port '{number[:40]}")


def test_an_unreadable_coordinate_or_matrix_cell_is_nan_and_reported_with_its_place() -> None:
    xml = in_root(
        "<Force><Plates><Plate/><Plate id='2'>",
        "<Location><Corner/><Corner><Point><X>1</X><Y>?</Y><Z>3</Z></Point></Corner></Location>",
        "<Calibration_Matrix><Row><Col>1</Col><Col>x</Col><Col>3</Col></Row></Calibration_Matrix>",
        "</Plate></Plates></Force>",
    )
    parameters, recovered = parse_parameters(xml)
    assert parameters.force is not None
    plate = parameters.force.plates[1]
    values = [value for point in plate.corners for value in (point.x, point.y, point.z)]
    assert list(map(math.isnan, values)) == [True, True, True, False, True, False]
    assert list(map(math.isnan, plate.calibration_matrix[0])) == [False, True, False]
    assert each_names(
        recovered,
        ["Force/Plates/Plate[2]/Location/Corner[2]/Point/Y", "'?'"],
        ["Force/Plates/Plate[2]/Calibration_Matrix/Row/Col[2]", "'x'"],
    )


@pytest.mark.parametrize("root", ["Parameters", "The_3D", "soap><RT_Parameters"])
def test_sections_under_another_root_are_found_and_reported(root: str) -> None:
    section = "<Markers><Marker id='1'/></Markers>"
    if root != "The_3D":
        section = f"<The_3D>{section}</The_3D>"
    closing = "".join(f"</{tag}>" for tag in reversed(root.split("><")))
    assert parse_parameters(f"<{root}>{section}{closing}".encode()) == (
        Parameters(markers=Parameters3D(markers=(Marker("1"),))),
        ("the root element is not RT_Parameters",),
    )


# Character encodings --------------------------------------------------------------------------

MICRO = in_root("<The_3D><Unit>µm</Unit></The_3D>").decode()


@pytest.mark.parametrize(
    ("start", "encoding"),
    [
        *((mark + each, "utf-8") for mark in ("", "\ufeff") for each in ("", "<?xml version='1.0'?>")),
        *(
            (f"<?xml version='1.0' encoding='{each}'?>", each)
            for each in ("UTF-8", "iso-8859-1", "ISO-8859-15")
        ),
    ],
)
def test_utf_8_and_declared_encodings_are_read(start: str, encoding: str) -> None:
    assert markers_of((start + MICRO).encode(encoding)).unit == "µm"


def test_bytes_that_are_not_of_the_declared_encoding_are_read_and_reported() -> None:
    for declaration in ("", "<?xml version='1.0' encoding='utf-8'?>"):
        markers, recovered = recovered_markers((declaration + MICRO).encode("latin-1"))
        assert (markers.unit, recovered) == ("µm", (recovered[0],))
        assert names(recovered[0], "Latin-1")
    markers, [fault, *_] = recovered_markers(b"<?xml version='1.0' encoding='klingon'?>" + spec_xml("3d"))
    assert (markers, "klingon" in fault) == (MARKERS, True)


# Attacks --------------------------------------------------------------------------------------


def error_text(xml: bytes) -> str:
    with pytest.raises(ParametersError) as caught:
        parse_parameters(xml)
    return str(caught.value)


@pytest.mark.parametrize(
    ("body", "quoted"),
    [
        *((b"", "''"), (b"\0", "''"), (b"<", "'<'"), (b"<a/>", "'<a/>'"), (b"x" * 60, f"'{'x' * 60}'")),
        (b"<html><body>404</body></html>", "'<html><body>404</body></html>'"),
        (b"x" * 61, f"'{'x' * 60}…'"),
        (b"\x1b[2J\xff" * 100, "'" + r"\x1b[2Jÿ" * 12 + "…'"),
    ],
)
def test_the_error_of_xml_without_parameters_quotes_60_characters(body: bytes, quoted: str) -> None:
    """The user sees which program answers; what it sent is printable and bounded."""
    text = error_text(body)
    assert (text.isprintable(), quoted in text) == (True, True)


def test_a_document_above_the_limit_is_an_error() -> None:
    """The limit protects the memory and the time for parsing; a document of that size is read."""
    start, end = b"<RT_Parameters><General>", b"</General></RT_Parameters>"
    xml = start + b" " * (MAX_XML_BYTES - len(start) - len(end)) + end
    assert parse_parameters(xml).parameters == Parameters(general=General())
    assert names(error_text(start + b" " + xml[len(start) :]), MAX_XML_BYTES + 1, MAX_XML_BYTES)


def test_entities_and_external_document_types_are_not_read(tmp_path: Path) -> None:
    unit = in_root("<The_3D><Unit>&e;</Unit></The_3D>")
    text = error_text(b"<!DOCTYPE x [<!ENTITY e 'ha'>]>" + unit)
    assert names(text, "entities")
    hidden = "<!DOCTYPE x [<!ENTITY e 'metre'>]>" + unit.decode()
    found = parse_parameters(b"\xfe\xff" + hidden.encode("utf-16-be")).parameters
    assert found == Parameters(markers=Parameters3D())
    dtd = tmp_path / "x.dtd"
    dtd.write_text("<!ATTLIST Marker id CDATA 'from the file'>")
    markers = in_root("<The_3D><Markers><Marker/></Markers></The_3D>")
    xml = f"<!DOCTYPE RT_Parameters SYSTEM '{dtd.as_uri()}'>".encode() + markers
    assert markers_of(xml).markers == (Marker(id=""),)


@pytest.mark.parametrize("tag", [b"a", b"Marker", b"Event", b"RT_Parameters"])
def test_deep_nesting_is_bounded(tag: bytes) -> None:
    xml = b"<RT_Parameters><The_3D><Unit>m</Unit><Markers>" + b"<%b>" % tag * 50_000
    markers, _ = recovered_markers(xml)
    assert (markers.unit, len(markers.markers) < 300) == ("m", True)


@pytest.mark.parametrize("reference", ["&#xD800;", "&#xdfff;", "&#56320;"])
def test_a_text_with_half_a_character_is_empty_and_the_others_are_read(reference: str) -> None:
    """It cannot be in UTF-8, so JSON and protobuf cannot have it."""
    markers = f"<Marker><Label>a{reference}</Label></Marker><Marker><Label>b</Label></Marker>"
    xml = in_root(f"<The_3D><Unit>m</Unit><Markers><Marker id='{reference}'/>{markers}</Markers></The_3D>")
    for body in (xml, xml.replace(b"</Unit>", b"")):
        found, _ = recovered_markers(body)
        assert "".join(marker.id + marker.label for marker in found.markers).removeprefix("a") == "b"


def test_the_number_of_items_and_the_length_of_texts_are_bounded() -> None:
    xml = in_root(f"<The_3D><Markers>{'<Marker/>' * (MAX_ITEMS + 1)}</Markers></The_3D>")
    markers, recovered = recovered_markers(xml)
    assert len(markers.markers) == MAX_ITEMS
    [note] = recovered
    assert names(note, MAX_ITEMS, "Markers/Marker")
    long = "x" * (MAX_TEXT_CHARACTERS + 1)
    marker = f"<Marker id='{long}'><Label>{long}</Label></Marker>"
    markers, recovered = recovered_markers(in_root(f"<The_3D><Markers>{marker}</Markers></The_3D>"))
    assert markers.markers == (Marker(long[:-1], long[:-1]),)
    assert [names(note, len(long), MAX_TEXT_CHARACTERS) for note in recovered] == [True, True]


# Encoding -------------------------------------------------------------------------------------


@pytest.mark.parametrize("section", SECTIONS)
def test_the_elements_are_those_of_the_example_in_the_specification(section: str) -> None:
    """Clients look for these tags, numbered where §6 numbers them."""
    tags = [
        re.findall(rb"<(\w+)", xml) for xml in (encode_parameters(BY_SECTION[section]), spec_xml(section))
    ]
    assert set(tags[0]) == set(tags[1])


def test_repeated_elements_are_numbered_and_no_others() -> None:
    """§6: an id counts the items of a list from 1, unless the server has its own."""
    root = etree.fromstring(encode_parameters(ALL))
    numbered = {"Marker", "Tool", "Channel", "Plate", "Corner", "Row", "Col", "Event", "Param", "ExpValue"}
    assert {element.tag for element in root.iter() if "id" in element.attrib} == numbered
    for element in root.iter():
        counts = Counter(child.tag for child in element)
        assert {tag for tag, count in counts.items() if count > 1} <= numbered
    [server] = root.findall("General/Server")
    assert [child.tag for child in server] == ["Name", "Ver", "IPadd", "Port", "Stats"]
    plate = Plate("9", corners=(Point(1, 2, 3),) * 2, calibration_matrix=((1.0, 2.0), (3.0, 4.0)))
    xml = encode_parameters(Parameters(force=ParametersForce((plate,))))
    found = re.findall(rb"<(Plate|Corner|Row|Col) id=\"(\d+)\"", xml)
    ids = b"Plate9 Corner1 Corner2 Row1 Col1 Col2 Row2 Col1 Col2"
    assert b" ".join(tag + number for tag, number in found) == ids


def test_the_xml_has_the_layout_of_the_specification_without_what_is_none() -> None:
    parameters = Parameters(
        general=General(), tools=Parameters6D(60.0, (Tool("1", "Hand", "", ("12", "14")),))
    )
    assert encode_parameters(parameters).decode().split("\n") == [
        '<RT_Parameters Ver="1.00">',
        *("  <General>", "    <Server>", "      <Name></Name>", "      <Ver></Ver>", "      <IPadd></IPadd>"),
        *("    </Server>", "  </General>", "  <The_6D>", "    <Frequency>60.0</Frequency>", "    <Tools>"),
        *('      <Tool id="1">', "        <Label>Hand</Label>", "        <Description></Description>"),
        *("        <Markers>", '          <Marker id="12"/>', '          <Marker id="14"/>'),
        *("        </Markers>", "      </Tool>", "    </Tools>", "  </The_6D>", "</RT_Parameters>", ""),
    ]


def test_the_xml_is_ascii_without_characters_that_it_cannot_represent() -> None:
    markers = Parameters3D(
        unit="µm", markers=(Marker("é", "a & b < c", "日本"), Marker("1\0", "a\x1b\ud800", "c\uffff\nd"))
    )
    xml = encode_parameters(Parameters(markers=markers))
    assert xml.isascii()
    assert markers_of(xml) == Parameters3D(unit="µm", markers=(markers.markers[0], Marker("1", "a", "c\nd")))


# Some sections of a reply ---------------------------------------------------------------------

WHOLE = (
    b"<?xml version='1.0'?><RT_Parameters Ver='1.00'><General/><!-- a comment -->"
    b"<The_3D><Unit>mm</Unit><Colour of='marker 1'>red &amp; blue</Colour></The_3D>\n"
    b"<the_6d/></RT_Parameters>\0\0"
)


def test_a_section_has_everything_that_the_server_wrote_in_it() -> None:
    assert extract_sections(WHOLE, ["3d"]) == (
        b'<RT_Parameters Ver="1.00">'
        b'<The_3D><Unit>mm</Unit><Colour of="marker 1">red &amp; blue</Colour></The_3D>\n</RT_Parameters>'
    )
    for encoding in ("utf-8", "latin-1"):
        found = extract_sections(MICRO.encode(encoding), ["3d"])
        assert found is not None
        assert markers_of(found).unit == "µm"


@pytest.mark.parametrize(
    "xml",
    [
        *(WHOLE.replace(b"The_3D", b"Other"), WHOLE.replace(b"</The_3D>", b""), b"", b"OK"),
        *(b"<html><The_3D/></html>", in_root("<The_3D/>" + " " * MAX_XML_BYTES)),
        b"<!DOCTYPE a [<!ENTITY b 'c'>]>" + in_root("<The_3D>&b;</The_3D>"),
    ],
)
def test_a_section_that_cannot_be_taken_from_the_reply_is_none(xml: bytes) -> None:
    """The gateway then asks the server for it; a part of what was asked for is not enough."""
    assert extract_sections(xml, ["3d"]) is None
    assert extract_sections(WHOLE, ["3d", "force"]) is None


def test_the_sections_of_a_reply_are_found_without_parsing_it() -> None:
    xml = in_root("<The_3D><Markers/></The_3D><FORCE\n><AnalogChannels/></FORCE><Events/>")
    assert named_sections(xml) == {"3d", "force", "events"}
    assert named_sections(b"<Generals><Event><The_6D" + b"<" * MAX_XML_BYTES + b"<Force>") == frozenset()
