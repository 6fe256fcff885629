"""The server's XML as text in LCM messages, and back."""

import pytest
import rtc3d

from gateway.messages.parameters_text import xml_bytes, xml_text
from gateway.messages.summary import summarise

CONTENT = "<RT_Parameters><The_3D><Marker><Label>Fuß</Label></Marker></The_3D></RT_Parameters>"


def declared(encoding: str) -> str:
    return f"<?xml version='1.0' encoding='{encoding}'?>{CONTENT}"


@pytest.mark.parametrize("encoding", ["ISO-8859-1", "latin1", "windows-1252", "UTF-8", "utf8"])
def test_xml_returns_to_the_encoding_that_it_declares(encoding: str) -> None:
    xml = declared(encoding).encode(encoding)
    assert xml_bytes(xml_text(xml)) == xml


def test_xml_without_a_declaration_is_utf_8() -> None:
    assert xml_bytes(CONTENT) == CONTENT.encode()


def test_text_that_does_not_fit_its_declared_encoding_is_utf_8() -> None:
    text = declared("ISO-8859-1").replace("Fuß", "足")
    assert xml_bytes(text) == text.encode()


def test_the_nuls_at_the_end_are_removed() -> None:
    assert xml_text(CONTENT.encode() + b"\0\0") == CONTENT


def test_the_summary_gives_the_size_of_the_xml_as_the_server_sent_it() -> None:
    xml = declared("ISO-8859-1").encode("iso-8859-1")
    reply = rtc3d.parameters_reply_t()
    reply.xml = xml_text(xml)
    assert f"{len(xml)} bytes of XML" in summarise(reply)
