"""The bytes of VRPN's protocol, worked out by hand from libvrpn's format."""

import pytest

from gateway.errors import PeerError
from gateway.outputs.vrpn.protocol import (
    COOKIE,
    TYPE_DESCRIPTIONS,
    ClientReader,
    describe_tracker,
    encode_pong,
    encode_pose,
    knock_port,
)

CLIENT_COOKIE = b"vrpn: ver. 07.38  0\0\0\0\0\0"
"""As a newer libvrpn sends it: another minor version is accepted."""


def words(text: str) -> bytes:
    return bytes.fromhex(text)


WAND = words(
    "00000021 00000000 00000000 00000003 ffffffff 00000000"  # length 24 + 9, time, number 3, type -1
    "00000005 77616e64 00000000 00000000"  # length of the name with NUL, "wand", NUL and padding
)
PING_IS_7 = (
    words("00000033 00000000 00000000 00000007 fffffffe 00000000 00000017")  # 24 + 27; number 7, type -2
    + b"vrpn_Base ping_message\0"
    + bytes(5)
)
PING_WAND = words("00000018 65f00000 00000001 00000003 00000007 00000000")


def ready_reader(*messages: bytes) -> ClientReader:
    reader = ClientReader()
    assert reader.receive(CLIENT_COOKIE + b"".join(messages)) == []
    return reader


def test_cookie_has_24_bytes_with_version_and_no_logging() -> None:
    assert COOKIE == b"vrpn: ver. 07.35  0\0\0\0\0\0"


def test_description_of_tracker() -> None:
    assert describe_tracker(3, "wand") == words(
        "00000021 00000000 00000000 00000003 ffffffff 00000000 00000005 77616e64 00000000 00000000"
    )


def test_descriptions_of_types_are_padded_to_8_bytes() -> None:
    pose = (
        words("00000032 00000000 00000000 00000000 fffffffe 00000000 00000016")  # 24 + 4 + 22
        + b"vrpn_Tracker Pos_Quat\0"
        + bytes(6)
    )
    pong = (
        words("00000033 00000000 00000000 00000001 fffffffe 00000000 00000017")
        + b"vrpn_Base pong_message\0"
        + bytes(5)
    )
    assert pose + pong == TYPE_DESCRIPTIONS


def test_pose_is_sensor_0_then_position_then_quaternion_with_scalar_last() -> None:
    # 1 710 000 000.25 s; position 1, 2, -0.5; the quaternion 0, 0, 0, 1. An error follows in Pose.
    assert encode_pose(2, 1_710_000_000_250_000, (1.0, 2.0, -0.5, 0.0, 0.0, 0.0, 1.0, 0.1)) == words(
        "00000058 65ec8780 0003d090 00000002 00000000 00000000"
        "00000000 00000000 3ff0000000000000 4000000000000000 bfe0000000000000"
        "0000000000000000 0000000000000000 0000000000000000 3ff0000000000000"
    )


@pytest.mark.parametrize(
    ("utime", "seconds", "microseconds"),
    [(-1, 0xFFFF_FFFF, 999_999), (2**63 - 1, (2**63 - 1) // 10**6 % 2**32, (2**63 - 1) % 10**6)],
)
def test_extreme_times_fit(utime: int, seconds: int, microseconds: int) -> None:
    header = encode_pong(5, utime)
    assert header == words(f"00000018 {seconds:08x} {microseconds:08x} 00000005 00000001 00000000")


def test_ping_returns_the_name_of_the_device() -> None:
    reader = ready_reader(PING_IS_7, WAND)
    assert reader.receive(PING_WAND) == ["wand"]


def test_pings_arrive_byte_by_byte() -> None:
    reader = ClientReader()
    stream = CLIENT_COOKIE + PING_IS_7 + WAND + PING_WAND + PING_WAND
    pinged = [name for byte in stream for name in reader.receive(bytes([byte]))]
    assert pinged == ["wand", "wand"]


def test_ping_of_unknown_number_is_ignored() -> None:
    reader = ready_reader(PING_IS_7)
    assert reader.receive(PING_WAND) == []


def test_type_number_that_gets_another_name_is_no_ping_any_more() -> None:
    other = PING_IS_7.replace(b"ping", b"pong")
    reader = ready_reader(PING_IS_7, WAND, other)
    assert reader.receive(PING_WAND) == []


def test_unknown_messages_are_skipped_with_their_padding() -> None:
    unknown = words("0000001d 00000000 00000000 00000003 00000009 00000000") + b"12345\0\0\0"
    udp = words("00000022 00000000 00000000 0000c813 fffffffd 00000000") + b"127.0.0.1\0" + bytes(6)
    reader = ready_reader(PING_IS_7, WAND)
    assert reader.receive(unknown + udp + PING_WAND) == ["wand"]


def test_body_that_is_skipped_is_not_kept() -> None:
    large = words("0000fa18 00000000 00000000 00000003 00000009 00000000")  # 64 000 bytes follow
    reader = ready_reader(PING_IS_7, WAND, large, bytes(63_999))
    assert reader.num_waiting_bytes == 0
    assert reader.receive(b"\0" + PING_WAND) == ["wand"]


@pytest.mark.parametrize(
    ("begin", "text"),
    [
        (b"GET / HTTP/1.1\r\n", "it does not speak VRPN 07; its first bytes are 'GET / HTTP/1.1'"),
        (b"\x16\x03\x01", r"its first bytes are '\x16\x03\x01'"),
        (b"vrpn: ver. 06.00  0\0\0\0\0\0", "its first bytes are 'vrpn: ver. 06.'"),
    ],
)
def test_other_protocols_are_refused_at_their_first_bytes(begin: bytes, text: str) -> None:
    with pytest.raises(PeerError) as refused:
        ClientReader().receive(begin)
    assert text in str(refused.value)


@pytest.mark.parametrize("length", [0, 23, 24 + 64_001, 0xFFFF_FFFF])
def test_impossible_lengths_are_refused(length: int) -> None:
    message = length.to_bytes(4, "big") + PING_WAND[4:]
    with pytest.raises(PeerError, match=f"a message of {length} bytes"):
        ready_reader().receive(message)


def test_long_description_is_refused() -> None:
    message = words("0000007d 00000000 00000000 00000003 ffffffff 00000000")  # 24 + 101
    with pytest.raises(PeerError, match="a description of 101 bytes"):
        ready_reader().receive(message)


@pytest.mark.parametrize("number", [-1, 2000, 0x7FFF_FFFF])
def test_number_outside_the_tables_is_refused(number: int) -> None:
    message = WAND[:12] + number.to_bytes(4, "big", signed=True) + WAND[16:]
    with pytest.raises(PeerError, match=f"describes number {number}"):
        ready_reader().receive(message)


def test_name_without_nul_and_name_that_is_not_utf_8() -> None:
    name = words("0000001e 00000000 00000000 00000003 ffffffff 00000000 00000002") + b"\xffa" + bytes(2)
    reader = ready_reader(PING_IS_7, name)
    assert reader.receive(PING_WAND) == ["�a"]


@pytest.mark.parametrize(
    ("datagram", "port"),
    [
        (b"127.0.0.1 51221\0", 51221),
        (b"10.1.2.3 1024", 1024),
        (b"lab-pc.local 65535\0\0", 65535),
        (b"127.0.0.1 1023\0", None),  # a system service
        (b"127.0.0.1 65536\0", None),
        (b"127.0.0.1 99999999\0", None),
        (b"127.0.0.1 -1\0", None),
        (b"127.0.0.1 51221 rm\0", None),
        (b"127.0.0.1\0 51221", None),
        (b"51221", None),
        (b"", None),
        (b"\xff" * 500, None),
    ],
)
def test_knock_port(datagram: bytes, port: int | None) -> None:
    assert knock_port(datagram) == port
