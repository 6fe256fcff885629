"""The bytes of VRPN's protocol, worked out by hand from libvrpn's format."""

import pytest

from gateway.errors import PeerError
from gateway.outputs.adapters.vrpn.protocol import (
    COOKIE,
    TYPE_DESCRIPTIONS,
    ClientReader,
    callback_port,
    describe_tracker,
    encode_pong,
    encode_pose,
)
from tests.support.errors import raises

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


def test_cookie_and_descriptions_are_padded_to_8_bytes() -> None:
    assert COOKIE == b"vrpn: ver. 07.35  0\0\0\0\0\0"
    assert describe_tracker(3, "wand") == WAND
    pose = words("00000032 00000000 00000000 00000000 fffffffe 00000000 00000016")  # 24 + 4 + 22
    pong = words("00000033 00000000 00000000 00000001 fffffffe 00000000 00000017")
    names = (b"vrpn_Tracker Pos_Quat\0" + bytes(6), b"vrpn_Base pong_message\0" + bytes(5))
    assert pose + names[0] + pong + names[1] == TYPE_DESCRIPTIONS


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


UNKNOWN = words("0000001d 00000000 00000000 00000003 00000009 00000000") + b"12345\0\0\0"
UDP = words("00000022 00000000 00000000 0000c813 fffffffd 00000000") + b"127.0.0.1\0" + bytes(6)
NO_UTF_8 = words("0000001e 00000000 00000000 00000003 ffffffff 00000000 00000002") + b"\xffa" + bytes(2)


@pytest.mark.parametrize(
    ("messages", "pinged"),
    [
        pytest.param([PING_IS_7, WAND, PING_WAND, PING_WAND], ["wand", "wand"], id="the name of the device"),
        pytest.param([PING_IS_7, PING_WAND], [], id="an unknown number"),
        pytest.param(
            [PING_IS_7, WAND, PING_IS_7.replace(b"ping", b"pong"), PING_WAND], [], id="another type"
        ),
        pytest.param([PING_IS_7, WAND, UNKNOWN, UDP, PING_WAND], ["wand"], id="padding is skipped"),
        pytest.param([PING_IS_7, NO_UTF_8, PING_WAND], ["�a"], id="neither NUL nor UTF-8"),
    ],
)
def test_pings_name_the_device(messages: list[bytes], pinged: list[str]) -> None:
    assert ClientReader().receive(b"".join([CLIENT_COOKIE, *messages])) == pinged


def test_body_that_is_skipped_is_not_kept() -> None:
    large = words("0000fa18 00000000 00000000 00000003 00000009 00000000")  # 64 000 bytes follow
    reader = ClientReader()
    assert reader.receive(CLIENT_COOKIE + PING_IS_7 + WAND + large + bytes(63_999)) == []
    assert reader.num_waiting_bytes == 0
    assert reader.receive(b"\0" + PING_WAND) == ["wand"]


def of_length(length: int) -> bytes:
    return CLIENT_COOKIE + length.to_bytes(4, "big") + PING_WAND[4:]


def describing(number: int) -> bytes:
    return CLIENT_COOKIE + WAND[:12] + number.to_bytes(4, "big", signed=True) + WAND[16:]


@pytest.mark.parametrize(
    ("begin", "value"),
    [
        (b"GET / HTTP/1.1\r\n", "'GET / HTTP/1.1'"),
        (b"\x16\x03\x01", r"'\x16\x03\x01'"),
        (b"vrpn: ver. 06.00  0\0\0\0\0\0", "'vrpn: ver. 06.'"),
        *((of_length(each), f"{each} bytes") for each in (0, 23, 24 + 64_001, 0xFFFF_FFFF)),
        (CLIENT_COOKIE + bytes.fromhex("0000007d") + WAND[4:], "101 bytes"),
        *((describing(number), f"number {number}") for number in (-1, 2000, 0x7FFF_FFFF)),
    ],
)
def test_what_breaks_the_protocol_is_refused(begin: bytes, value: str) -> None:
    with raises(PeerError, value):
        ClientReader().receive(begin)


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
def test_callback_port(datagram: bytes, port: int | None) -> None:
    assert callback_port(datagram) == port
