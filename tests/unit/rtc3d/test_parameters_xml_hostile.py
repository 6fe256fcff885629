"""XML that attacks the parser of parameters, and data that is not XML."""

from pathlib import Path

import pytest

from gateway.errors import ParametersError
from gateway.rtc3d.parameters import General, Marker, Parameters, Parameters3D
from gateway.rtc3d.parameters_xml import (
    MAX_ITEMS,
    MAX_RECOVERED,
    MAX_TEXT_CHARACTERS,
    MAX_XML_BYTES,
    named_sections,
    parse_parameters,
)
from tests.spec_parameters import in_root, markers_of

CHECK = "check host and port"


def error_text(xml: bytes) -> str:
    with pytest.raises(ParametersError) as caught:
        parse_parameters(xml)
    return str(caught.value)


class TestHostileXml:
    @pytest.mark.parametrize(
        ("body", "quoted"),
        [
            *((b"", "''"), (b"\0", "''"), (b"hello", "'hello'"), (b"<", "'<'"), (b"<a/>", "'<a/>'")),
            (b"<html><body>404</body></html>", "'<html><body>404</body></html>'"),
            (b"x" * 60, f"'{'x' * 60}'"),
            (b"x" * 61, f"'{'x' * 60}…'"),
            (b"\x1b[2J\xff" * 100, "'" + r"\x1b[2Jÿ" * 12 + "…'"),
        ],
    )
    def test_the_error_of_xml_without_parameters_quotes_60_characters(self, body: bytes, quoted: str) -> None:
        """The user sees which program answers; what it sent is printable and bounded."""
        text = error_text(body)
        assert text.startswith("the server's XML has no parameters but begins with '")
        assert text.endswith(f"; {CHECK}, and that this is an RTC3D server")
        assert text.isprintable()
        assert quoted in text

    def test_a_document_above_the_limit_is_an_error(self) -> None:
        """The limit protects the memory and the time for parsing; a document of that size is read."""
        start, end = b"<RT_Parameters><General>", b"</General></RT_Parameters>"
        xml = start + b" " * (MAX_XML_BYTES - len(start) - len(end)) + end
        assert parse_parameters(xml).parameters == Parameters(general=General())
        assert error_text(start + b" " + xml[len(start) :]) == (
            f"the server's parameters take {MAX_XML_BYTES + 1} bytes, above the limit of {MAX_XML_BYTES}: "
            f"this is not an RTC3D server, or it is faulty; {CHECK}"
        )

    def test_entities_are_an_error(self) -> None:
        entities = "".join(f"<!ENTITY e{n} '{f'&e{n - 1};' * 10}'>" for n in range(1, 12))
        xml = (
            f"<!DOCTYPE x [<!ENTITY e0 'ha'>{entities}]>"
            + in_root("<The_3D><Unit>&e11;</Unit></The_3D>").decode()
        )
        assert error_text(xml.encode()) == (
            "the server's parameters declare XML entities, which RTC3D does not have, so they are not read; "
            f"{CHECK}"
        )

    def test_entities_hidden_by_an_encoding_are_not_expanded(self) -> None:
        xml = "<!DOCTYPE x [<!ENTITY e 'metre'>]>" + in_root("<The_3D><Unit>&e;</Unit></The_3D>").decode()
        parameters = parse_parameters(b"\xfe\xff" + xml.encode("utf-16-be")).parameters
        assert parameters == Parameters(markers=Parameters3D())

    def test_an_external_document_type_is_not_fetched(self, tmp_path: Path) -> None:
        dtd = tmp_path / "x.dtd"
        dtd.write_text("<!ATTLIST Marker id CDATA 'from the file'>")
        xml = f"<!DOCTYPE RT_Parameters SYSTEM '{dtd.as_uri()}'>".encode() + in_root(
            "<The_3D><Markers><Marker/></Markers></The_3D>"
        )
        assert markers_of(xml).markers == (Marker(id=""),)

    @pytest.mark.parametrize("tag", [b"a", b"Marker", b"Event", b"RT_Parameters"])
    def test_deep_nesting_is_bounded(self, tag: bytes) -> None:
        xml = b"<RT_Parameters><The_3D><Unit>m</Unit><Markers>" + b"<%b>" % tag * 50_000
        parameters, recovered = parse_parameters(xml)
        assert parameters.markers is not None
        assert parameters.markers.unit == "m"
        assert len(parameters.markers.markers) < 300
        assert recovered

    def test_the_number_of_reported_faults_is_bounded(self) -> None:
        cells = "<Col/>" * 5_000 + "<Col>a</Col>" * 5_000
        matrix = f"<Calibration_Matrix><Row>{cells}</Row></Calibration_Matrix>"
        xml = in_root(f"<Force><Plates><Plate>{matrix}</Plate></Plates></Force>")
        parameters, recovered = parse_parameters(xml)
        assert parameters.force is not None
        assert len(parameters.force.plates[0].calibration_matrix[0]) == 10_000
        assert len(recovered) == MAX_RECOVERED

    def test_control_characters_in_malformed_xml_are_dropped(self) -> None:
        xml = in_root("<The_3D><Unit>m\x01m</Unit><Markers><Marker id='\x02&#3;1'/></Markers></The_3D>")
        parameters, recovered = parse_parameters(xml)
        assert parameters.markers is not None
        assert parameters.markers.unit == "mm"
        assert recovered

    @pytest.mark.parametrize("reference", ["&#xD800;", "&#xdfff;", "&#56320;"])
    def test_a_text_with_half_a_character_is_empty_and_the_others_are_read(self, reference: str) -> None:
        """It cannot be in UTF-8, so JSON and protobuf cannot have it."""
        markers = f"<Marker><Label>a{reference}</Label></Marker><Marker><Label>b</Label></Marker>"
        xml = in_root(
            f"<The_3D><Unit>m</Unit><Markers><Marker id='{reference}'/>{markers}</Markers></The_3D>"
        )
        for body in (xml, xml.replace(b"</Unit>", b"")):
            parameters, recovered = parse_parameters(body)
            assert parameters.markers is not None
            labels = "".join(marker.id + marker.label for marker in parameters.markers.markers)
            assert labels.removeprefix("a") == "b"
            assert recovered

    def test_the_number_of_items_is_bounded(self) -> None:
        xml = in_root(f"<The_3D><Markers>{'<Marker/>' * (MAX_ITEMS + 1)}</Markers></The_3D>")
        parameters, recovered = parse_parameters(xml)
        assert parameters.markers is not None
        assert len(parameters.markers.markers) == MAX_ITEMS
        assert recovered == (f"more than {MAX_ITEMS} elements Markers/Marker: the others are left out",)

    def test_texts_are_cut(self) -> None:
        long = "x" * (MAX_TEXT_CHARACTERS + 1)
        marker = f"<Marker id='{long}'><Label>{long}</Label></Marker>"
        parameters, recovered = parse_parameters(in_root(f"<The_3D><Markers>{marker}</Markers></The_3D>"))
        assert parameters.markers is not None
        [found] = parameters.markers.markers
        assert (found.id, found.label) == (long[:-1], long[:-1])
        assert recovered == 2 * (f"a text of {len(long)} characters is cut to {MAX_TEXT_CHARACTERS}",)


class TestNamedSections:
    def test_the_sections_of_a_reply_are_found_without_parsing_it(self) -> None:
        xml = in_root("<The_3D><Markers/></The_3D><FORCE\n><AnalogChannels/></FORCE><Events/>")
        assert named_sections(xml) == {"3d", "force", "events"}

    def test_other_bytes_have_no_sections(self) -> None:
        assert named_sections(b"<Generals><Event><The_6D" + b"<" * MAX_XML_BYTES + b"<Force>") == frozenset()
