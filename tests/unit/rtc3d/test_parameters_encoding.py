"""The XML that the gateway writes has §6's nesting: nothing but numbered elements is repeated."""

from collections import Counter

import pytest
from lxml import etree

from gateway.rtc3d.parameters_xml import encode_parameters
from tests.spec_parameters import ALL

NUMBERED = {
    *("Marker", "Tool", "Channel", "Plate", "Corner", "Row", "Col", "Event", "Param", "ExpValue"),
}


@pytest.fixture(scope="module")
def root() -> etree._Element:
    return etree.fromstring(encode_parameters(ALL))


def test_an_element_stands_once_below_its_parent_unless_it_is_numbered(root: etree._Element) -> None:
    repeated = {
        tag
        for element in root.iter()
        for tag, count in Counter(child.tag for child in element).items()
        if count > 1
    }
    assert repeated
    assert repeated <= NUMBERED


def test_numbered_elements_have_ids_and_others_have_none(root: etree._Element) -> None:
    with_id = {element.tag for element in root.iter() if "id" in element.attrib}
    assert with_id == NUMBERED


def test_all_of_the_server_stands_in_one_element(root: etree._Element) -> None:
    [server] = root.findall("General/Server")
    assert [child.tag for child in server] == ["Name", "Ver", "IPadd", "Port", "Stats"]
