"""Parameters (§6): the specification's examples, malformed XML, faults of real servers, and encoding."""

import math
import re
from collections import Counter

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
    MAX_RECOVERED,
    MAX_XML_BYTES,
    encode_parameters,
    extract_sections,
    parse_parameters,
)
from tests.spec_parameters import ALL, BY_SECTION, MARKERS, PLATE, in_root, markers_of, spec_body, spec_xml


class TestExamplesOfTheSpecification:
    @pytest.mark.parametrize(
        ("section", "faults"),
        [
            *(("general", []), ("3d", []), ("6d", []), ("analog", [])),
            ("force", [("line 70: ", "Channel")]),  # a stray end tag
            ("events", [("line 13: ", "Description"), ("line 24: ", "Description")]),  # without end tags
        ],
    )
    def test_every_field_is_read_and_faults_are_reported_with_their_lines(
        self, section: str, faults: list[tuple[str, str]]
    ) -> None:
        """The specification's own examples are not all well-formed, and vendors copied them."""
        parameters, recovered = parse_parameters(spec_xml(section))
        assert parameters == BY_SECTION[section]
        for line, tag in faults:
            assert [note for note in recovered if note.startswith(line) and tag in note]
        assert bool(recovered) is bool(faults)

    @pytest.mark.parametrize("first", SECTIONS)
    def test_all_sections_are_read_from_one_document_in_any_order(self, first: str) -> None:
        sections = list(SECTIONS)
        start = sections.index(first)
        order = sections[start:] + sections[:start]
        xml = b"<RT_Parameters Ver='1.00'>%b</RT_Parameters>" % b"".join(map(spec_body, order))
        assert parse_parameters(xml).parameters == ALL


class TestBrokenNesting:
    def test_a_stray_end_tag_in_each_of_twenty_plates_loses_nothing_after_it(self) -> None:
        plate = spec_body("force").partition(b"<Plates>")[2].rpartition(b"</Plates>")[0]
        plates = b"".join(plate.replace(b"<Plate id = '1'", b"<Plate id='%d'" % n) for n in range(20))
        xml = (
            b"<RT_Parameters><Force><Plates>%b</Plates></Force>" % plates
            + spec_body("3d")
            + b"</RT_Parameters>"
        )
        parameters = parse_parameters(xml).parameters
        assert parameters.force is not None
        assert [plate.id for plate in parameters.force.plates] == [str(n) for n in range(20)]
        assert {plate.channels for plate in parameters.force.plates} == {PLATE.channels}
        assert {plate.calibration_matrix for plate in parameters.force.plates} == {PLATE.calibration_matrix}
        assert parameters.markers == MARKERS

    def test_markers_whose_end_tag_is_missing_are_siblings_in_their_order(self) -> None:
        markers = "".join(f"<Marker id='{n}'><Label>m{n}</Label>" for n in range(5))
        xml = in_root(f"<The_3D><Markers>{markers}</Markers></The_3D>")
        found = parse_parameters(xml).parameters.markers
        assert found is not None
        assert found.markers == tuple(Marker(str(n), f"m{n}") for n in range(5))

    def test_the_first_value_of_a_field_wins(self) -> None:
        xml = in_root("<The_3D><Unit>m</Unit><Unit>mm</Unit></The_3D>")
        assert markers_of(xml).unit == "m"

    def test_an_unescaped_ampersand_stays_in_its_label(self) -> None:
        xml = in_root(
            "<The_3D><Markers><Marker id='1'><Label>L&R &lt; &nbsp;</Label></Marker></Markers></The_3D>"
        )
        parameters, recovered = parse_parameters(xml)
        assert parameters.markers == Parameters3D(markers=(Marker("1", "L&R < &nbsp;"),))
        assert recovered

    def test_a_truncated_document_is_read_in_part_and_reported_or_is_an_error(self) -> None:
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

    def test_the_report_is_bounded_and_printable(self) -> None:
        xml = in_root(f"<The_3D><Unit>m\0m</Unit><{'x' * 5000}>{'&' * 5000}</The_3D>")
        recovered = parse_parameters(xml).recovered
        assert len(recovered) == MAX_RECOVERED
        assert all(note.isprintable() and len(note) <= 200 for note in recovered)
        cut = parse_parameters(xml.replace(b"&", b"")).recovered
        assert "x" * 100 in "".join(cut)
        assert max(map(len, cut)) == 200


class TestRealServers:
    def test_what_servers_vary_does_not_matter(self) -> None:
        """Endings, the case of tags and attributes, and a namespace change no value and are no faults."""
        xml = spec_xml("3d")
        lower = re.sub(rb"(</?)(\w+)", lambda tag: tag[1] + tag[2].lower(), xml)
        for variant in (
            *(xml + end for end in (b"\0", b"\0\0\0\n", b"\r\n\0", b" \t\n")),
            *(lower, lower.replace(b"id =", b"ID ="), xml.replace(b" Ver", b" xmlns='ndi' Ver", 1)),
        ):
            assert parse_parameters(variant) == (Parameters(markers=MARKERS), ())
        assert parse_parameters(b"<RT_Parameters Ver='1.00'></RT_Parameters>") == (Parameters(), ())
        parameters, recovered = parse_parameters(b"OK-SendParameters 3D\n" + xml)
        assert parameters == Parameters(markers=MARKERS)
        assert recovered

    def test_unknown_elements_text_comments_and_order_do_not_matter(self) -> None:
        xml = in_root(
            "text <Vendor><The_3D><Unit>inch</Unit></The_3D><Label>x</Label></Vendor>",
            "<The_3D><!-- ours --> dots . . . <Markers>, <Marker id='1' colour='red'><Colour/>",
            "<Description>left<!-- side --><?pi?> arm</Description><Label>a</Label></Marker> .</Markers>",
            "<Vendor><Unit>inch</Unit></Vendor><Frequency> 100 </Frequency></The_3D>",
        )
        assert markers_of(xml) == Parameters3D(100.0, "mm", (Marker("1", "a", "left arm"),))

    def test_marker_ids_may_be_any_text(self) -> None:
        ids = ["0", "7", "7", "-1", "0x123456", "left arm", ""]
        markers = "".join(f"<Marker id = ' {marker_id} '></Marker>" for marker_id in ids)
        xml = in_root(f"<The_3D><Markers>{markers}<Marker/></Markers></The_3D>")
        assert [marker.id for marker in markers_of(xml).markers] == [*ids, ""]

    def test_absent_and_empty_values_get_their_defaults(self) -> None:
        xml = in_root(
            "<General/>",
            "<The_3D><Frequency></Frequency><Unit> </Unit></The_3D>",
            "<Analog><Channels><Channel id='1'/></Channels></Analog>",
            "<Events><Event id='1'><Params><Param id='1'><Type/></Param></Params></Event></Events>",
        )
        parameters, recovered = parse_parameters(xml)
        assert parameters == Parameters(
            general=General(),
            markers=Parameters3D(frequency_hz=None, unit="mm"),
            analog=ParametersAnalog((AnalogChannel("1", unit="mV"),)),
            events=ParametersEvents((EventDefinition("1", parameters=(EventParameter("1", "int"),)),)),
        )
        assert recovered == ()

    @pytest.mark.parametrize("number", ["abc", "60,0", "nan", "-inf", "1e999", "0x10"])
    def test_a_frequency_that_is_not_a_number_is_none_and_reported(self, number: str) -> None:
        xml = in_root(f"<The_3D><Frequency>{number}</Frequency></The_3D>")
        assert parse_parameters(xml) == (
            Parameters(markers=Parameters3D(frequency_hz=None)),
            (f"The_3D/Frequency '{number}' is not a number",),
        )

    @pytest.mark.parametrize("number", ["3020.0", "9" * 400, "9" * 5000])
    def test_a_port_that_is_not_a_whole_number_is_none_and_reported(self, number: str) -> None:
        xml = in_root(f"<General><Server><Port>{number}</Port></Server></General>")
        parameters, recovered = parse_parameters(xml)
        assert parameters == Parameters(general=General())
        assert len(recovered) == 1
        assert recovered[0].startswith(f"General/Server/Port '{number[:40]}")

    def test_an_unreadable_coordinate_or_matrix_cell_is_nan(self) -> None:
        xml = in_root(
            "<Force><Plates><Plate/><Plate id='2'>",
            "<Location><Corner/><Corner><Point><X>1</X><Y>?</Y><Z>3</Z></Point></Corner></Location>",
            "<Calibration_Matrix><Row><Col>1</Col><Col>x</Col><Col>3</Col></Row></Calibration_Matrix>",
            "</Plate></Plates></Force>",
        )
        parameters, recovered = parse_parameters(xml)
        assert parameters.force is not None
        plate = parameters.force.plates[1]
        assert [math.isnan(value) for point in plate.corners for value in (point.x, point.y, point.z)] == [
            True, True, True, False, True, False
        ]  # fmt: skip
        assert [math.isnan(cell) for cell in plate.calibration_matrix[0]] == [False, True, False]
        assert recovered == (
            "Force/Plates/Plate[2]/Location/Corner[2]/Point/Y '?' is not a number",
            "Force/Plates/Plate[2]/Calibration_Matrix/Row/Col[2] 'x' is not a number",
        )

    @pytest.mark.parametrize("root", ["Parameters", "The_3D", "soap><RT_Parameters"])
    def test_sections_under_another_root_are_found_and_reported(self, root: str) -> None:
        section = "<Markers><Marker id='1'/></Markers>"
        if root != "The_3D":
            section = f"<The_3D>{section}</The_3D>"
        closing = "".join(f"</{tag}>" for tag in reversed(root.split("><")))
        assert parse_parameters(f"<{root}>{section}{closing}".encode()) == (
            Parameters(markers=Parameters3D(markers=(Marker("1"),))),
            ("the root element is not RT_Parameters",),
        )


class TestCharacterEncodings:
    XML = in_root("<The_3D><Unit>µm</Unit></The_3D>").decode()

    @pytest.mark.parametrize(
        "declaration", ["", "<?xml version='1.0'?>", "<?xml version='1.0' encoding='UTF-8'?>"]
    )
    @pytest.mark.parametrize("mark", ["", "\ufeff"])
    def test_utf_8_is_read_with_or_without_declaration_and_mark(self, declaration: str, mark: str) -> None:
        assert markers_of((mark + declaration + self.XML).encode()).unit == "µm"

    @pytest.mark.parametrize("encoding", ["iso-8859-1", "windows-1252", "ISO-8859-15"])
    def test_a_declared_encoding_is_used(self, encoding: str) -> None:
        xml = f"<?xml version='1.0' encoding='{encoding}'?>{self.XML}".encode(encoding)
        assert markers_of(xml).unit == "µm"

    @pytest.mark.parametrize("declaration", ["", "<?xml version='1.0' encoding='utf-8'?>"])
    def test_bytes_that_are_not_utf_8_are_read_as_latin_1_and_reported(self, declaration: str) -> None:
        parameters, recovered = parse_parameters((declaration + self.XML).encode("latin-1"))
        assert parameters == Parameters(markers=Parameters3D(unit="µm"))
        assert recovered == ("bytes that are not UTF-8 were read as Latin-1",)

    def test_an_unknown_declared_encoding_is_reported(self) -> None:
        xml = b"<?xml version='1.0' encoding='klingon'?>" + spec_xml("3d")
        parameters, recovered = parse_parameters(xml)
        assert parameters == Parameters(markers=MARKERS)
        assert "klingon" in recovered[0]


class TestEncoding:
    @pytest.mark.parametrize("section", SECTIONS)
    def test_the_elements_are_those_of_the_example_in_the_specification(self, section: str) -> None:
        """Clients look for these tags, numbered where §6 numbers them."""

        def tags(xml: bytes) -> set[bytes]:
            return set(re.findall(rb"<(\w+)", xml))

        assert tags(encode_parameters(BY_SECTION[section])) == tags(spec_xml(section))

    def test_repeated_elements_are_numbered_and_no_others(self) -> None:
        """§6: an id counts the items of a list from 1, unless the server has its own."""
        root = etree.fromstring(encode_parameters(ALL))
        numbered = {"Marker", "Tool", "Channel", "Plate", "Corner", "Row", "Col"}
        numbered |= {"Event", "Param", "ExpValue"}
        assert {element.tag for element in root.iter() if "id" in element.attrib} == numbered
        for element in root.iter():
            counts = Counter(child.tag for child in element)
            assert {tag for tag, count in counts.items() if count > 1} <= numbered
        [server] = root.findall("General/Server")
        assert [child.tag for child in server] == ["Name", "Ver", "IPadd", "Port", "Stats"]
        plate = Plate("9", corners=(Point(1, 2, 3),) * 2, calibration_matrix=((1.0, 2.0), (3.0, 4.0)))
        xml = encode_parameters(Parameters(force=ParametersForce((plate,))))
        found = re.findall(rb"<(Plate|Corner|Row|Col) id=\"(\d+)\"", xml)
        assert b" ".join(tag + number for tag, number in found) == (
            b"Plate9 Corner1 Corner2 Row1 Col1 Col2 Row2 Col1 Col2"
        )

    def test_the_xml_has_the_layout_of_the_specification(self) -> None:
        tools = Parameters6D(60.0, (Tool("1", "Hand", "", ("12", "14")),))
        assert encode_parameters(Parameters(tools=tools)) == (
            b'<RT_Parameters Ver="1.00">\n'
            b"  <The_6D>\n"
            b"    <Frequency>60.0</Frequency>\n"
            b"    <Tools>\n"
            b'      <Tool id="1">\n'
            b"        <Label>Hand</Label>\n"
            b"        <Description></Description>\n"
            b"        <Markers>\n"
            b'          <Marker id="12"/>\n'
            b'          <Marker id="14"/>\n'
            b"        </Markers>\n"
            b"      </Tool>\n"
            b"    </Tools>\n"
            b"  </The_6D>\n"
            b"</RT_Parameters>\n"
        )

    def test_sections_and_numbers_that_are_none_are_left_out(self) -> None:
        xml = encode_parameters(Parameters(general=General(), analog=ParametersAnalog()))
        assert set(re.findall(rb"<(\w+)", xml)) == {
            b"RT_Parameters", b"General", b"Server", b"Name", b"Ver", b"IPadd", b"Analog", b"Channels"
        }  # fmt: skip

    def test_the_xml_is_ascii_whatever_the_labels_are(self) -> None:
        markers = Parameters3D(unit="µm", markers=(Marker("é", "a & b < c", "日本"),))
        xml = encode_parameters(Parameters(markers=markers))
        assert xml.isascii()
        assert markers_of(xml) == markers

    def test_characters_that_xml_cannot_represent_are_dropped(self) -> None:
        markers = Parameters3D(markers=(Marker("1\0", "a\x1bb\ud800", "c\uffff\nd"),))
        xml = encode_parameters(Parameters(markers=markers))
        assert markers_of(xml).markers == (Marker("1", "ab", "c\nd"),)


# One section of a reply ------------------------------------------------------------------------

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


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_names_in_a_section_are_readable_in_any_encoding(encoding: str) -> None:
    label = "<The_3D><Markers><Marker id='1'><Label>Fuß</Label></Marker></Markers></The_3D>"
    xml = extract_sections(in_root(label).decode().encode(encoding), ["3d"])
    assert xml is not None
    assert [marker.label for marker in markers_of(xml).markers] == ["Fuß"]


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
