import pytest

from gateway.errors import PacketError
from gateway.rtc3d.packets import Packet, encode_packet


def test_packets_of_the_same_type_and_body_are_equal_and_have_one_hash() -> None:
    assert Packet(3, b"frame") == Packet(3, b"frame")
    assert len({Packet(3, b"frame"), Packet(3, b"frame"), Packet(4, b"frame"), Packet(3, b"other")}) == 3


@pytest.mark.parametrize("other", [Packet(4, b"frame"), Packet(3, b"other"), (3, b"frame"), b"frame", None])
def test_a_packet_does_not_equal_another_type_another_body_or_another_kind_of_object(other: object) -> None:
    assert Packet(3, b"frame") != other


def test_a_packet_shows_its_type_and_body() -> None:
    assert repr(Packet(1, b"Bye")) == "Packet(1, b'Bye')"


def test_a_packet_without_a_body_is_its_header_alone() -> None:
    assert encode_packet(4) == b"\0\0\0\x08\0\0\0\x04"


def test_the_error_of_a_packet_that_cannot_be_encoded_has_no_place_in_a_stream() -> None:
    with pytest.raises(PacketError) as caught:
        encode_packet(2, bytes(0xFFFFFFFF - 7))
    assert str(caught.value) == "a packet of 4294967296 bytes does not fit its 32-bit size field"
    assert caught.value.offset == 0
