"""Parameters (§6): the specification's examples, malformed XML, faults of real servers, and encoding."""

import math
import re

import pytest

from gateway.errors import ParametersError
from gateway.rtc3d.parameters import (
    SECTIONS,
    AnalogChannel,
    EventDefinition,
    EventParameter,
    ExpectedValue,
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
    sections_of,
)
from gateway.rtc3d.parameters_xml import (
    MAX_RECOVERED,
    MAX_XML_BYTES,
    encode_parameters,
    extract_sections,
    parse_parameters,
)
from tests.spec_parameters import (
    ALL,
    BY_SECTION,
    MARKERS,
    PLATE,
    in_root,
    markers_of,
    spec_body,
    spec_xml,
)


class TestExamplesOfTheSpecification:
    @pytest.mark.parametrize("section", SECTIONS)
    def test_every_field_is_read(self, section: str) -> None:
        assert parse_parameters(spec_xml(section)).parameters == BY_SECTION[section]

    @pytest.mark.parametrize("section", ["general", "3d", "6d", "analog"])
    def test_the_well_formed_ones_have_no_faults(self, section: str) -> None:
        assert parse_parameters(spec_xml(section)).recovered == ()

    def test_the_stray_end_tag_of_force_is_reported_with_its_line(self) -> None:
        recovered = parse_parameters(spec_xml("force")).recovered
        assert recovered[0].startswith("line 70: ")
        assert "Channel" in recovered[0]

    def test_the_unclosed_descriptions_of_events_are_reported_with_their_lines(self) -> None:
        recovered = parse_parameters(spec_xml("events")).recovered
        assert [note for note in recovered if "Description" in note and note.startswith("line 13: ")]
        assert [note for note in recovered if "Description" in note and note.startswith("line 24: ")]

    @pytest.mark.parametrize("first", SECTIONS)
    def test_all_sections_are_read_from_one_document_in_any_order(self, first: str) -> None:
        sections = list(SECTIONS)
        start = sections.index(first)
        order = sections[start:] + sections[:start]
        xml = b"<RT_Parameters Ver='1.00'>%b</RT_Parameters>" % b"".join(map(spec_body, order))
        assert parse_parameters(xml).parameters == ALL

    @pytest.mark.parametrize("section", SECTIONS)
    def test_the_section_in_a_reply_is_found(self, section: str) -> None:
        assert sections_of(parse_parameters(spec_xml(section)).parameters) == {section}


class TestBrokenNesting:
    def test_two_events_with_three_parameters_each_and_no_description_closed(self) -> None:
        def value(number: int) -> str:
            return f"""
                <ExpValue id='{number}'>
                  <Value>{number * 10}</Value><Label>V{number}</Label><Description>value {number}
                </ExpValue>"""

        def parameter(number: int) -> str:
            return f"""
              <Param id='{number}'>
                <Type>float</Type><Description>parameter {number}
                <ExpValues>{value(1)}{value(2)}</ExpValues>
              </Param>"""

        def event(number: int) -> str:
            return f"""
              <Event id='{number}'>
                <Label>E{number}</Label><Description>event {number}
                <Params>{parameter(1)}{parameter(2)}{parameter(3)}</Params>
              </Event>"""

        parameters, recovered = parse_parameters(in_root(f"<Events>{event(7)}{event(8)}</Events>"))

        values = tuple(ExpectedValue(str(n), str(n * 10), f"V{n}", f"value {n}") for n in (1, 2))
        expected = tuple(
            EventDefinition(
                str(n),
                f"E{n}",
                f"event {n}",
                tuple(EventParameter(str(m), "float", f"parameter {m}", values) for m in (1, 2, 3)),
            )
            for n in (7, 8)
        )
        assert parameters == Parameters(events=ParametersEvents(expected))
        assert recovered

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
        xml = encode_parameters(ALL).strip()
        complete = 0
        for end in range(len(xml)):
            try:
                parameters, recovered = parse_parameters(xml[:end])
            except ParametersError:
                assert end < len("<RT_Parameters Ver='1.00'>")
            else:
                assert recovered, xml[:end]
                complete += parameters == ALL
        last_text = b"Button was released"
        assert complete == len(xml) - (xml.index(last_text) + len(last_text))

    def test_the_report_is_bounded_and_printable(self) -> None:
        xml = in_root(f"<The_3D><Unit>m\0m</Unit><{'x' * 5000}>{'&' * 5000}</The_3D>")
        recovered = parse_parameters(xml).recovered
        assert len(recovered) == MAX_RECOVERED
        assert all(note.isprintable() and len(note) <= 200 for note in recovered)
        cut = parse_parameters(xml.replace(b"&", b"")).recovered
        assert "x" * 100 in "".join(cut)
        assert max(map(len, cut)) == 200


class TestRealServers:
    @pytest.mark.parametrize("end", [b"\0", b"\0\0\0\n", b"\r\n\0", b" \t\n"])
    def test_nuls_and_white_space_at_the_end_are_dropped_silently(self, end: bytes) -> None:
        assert markers_of(spec_xml("3d") + end) == MARKERS

    def test_text_before_the_xml_is_skipped_and_reported(self) -> None:
        parameters, recovered = parse_parameters(b"OK-SendParameters 3D\n" + spec_xml("3d"))
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

    def test_the_case_of_tags_does_not_matter(self) -> None:
        xml = re.sub(rb"(</?)(\w+)", lambda tag: tag[1] + tag[2].lower(), spec_xml("3d"))
        assert b"<markers>" in xml
        assert markers_of(xml) == MARKERS
        assert markers_of(xml.replace(b"id =", b"ID =")) == MARKERS

    def test_a_namespace_does_not_matter(self) -> None:
        assert markers_of(spec_xml("3d").replace(b" Ver", b" xmlns='ndi' Ver", 1)) == MARKERS

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

    def test_a_reply_without_sections_is_no_error(self) -> None:
        assert parse_parameters(b"<RT_Parameters Ver='1.00'></RT_Parameters>") == (Parameters(), ())

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

    def test_malformed_latin_1_is_read_and_reported(self) -> None:
        parameters, recovered = parse_parameters(self.XML.replace("</The_3D>", "").encode("latin-1"))
        assert parameters == Parameters(markers=Parameters3D(unit="µm"))
        assert len(recovered) == 2

    def test_an_unknown_declared_encoding_is_reported(self) -> None:
        xml = b"<?xml version='1.0' encoding='klingon'?>" + spec_xml("3d")
        parameters, recovered = parse_parameters(xml)
        assert parameters == Parameters(markers=MARKERS)
        assert "klingon" in recovered[0]


class TestEncoding:
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

    def test_corners_rows_and_columns_are_numbered_from_one(self) -> None:
        plate = Plate("9", corners=(Point(1, 2, 3),) * 2, calibration_matrix=((1.0, 2.0), (3.0, 4.0)))
        xml = encode_parameters(Parameters(force=ParametersForce((plate,))))
        assert re.findall(rb"<(Plate|Corner|Row|Col) id=\"(\d+)\"", xml) == [
            (b"Plate", b"9"),
            (b"Corner", b"1"), (b"Corner", b"2"),
            (b"Row", b"1"), (b"Col", b"1"), (b"Col", b"2"),
            (b"Row", b"2"), (b"Col", b"1"), (b"Col", b"2"),
        ]  # fmt: skip

    @pytest.mark.parametrize("section", SECTIONS)
    def test_the_elements_are_those_of_the_example_in_the_specification(self, section: str) -> None:
        def tags(xml: bytes) -> set[bytes]:
            return set(re.findall(rb"<(\w+)", xml))

        assert tags(encode_parameters(BY_SECTION[section])) == tags(spec_xml(section))

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


def test_several_sections_are_in_the_order_of_the_reply() -> None:
    both = extract_sections(WHOLE, ["6d", "general"])
    assert both == b'<RT_Parameters Ver="1.00"><General/><the_6d/></RT_Parameters>'


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
    assert extract_sections(xml, ["3d"]) is None
