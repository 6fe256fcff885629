"""Requests on LCM's multicast, which the gateway receives without LCM's library."""

import socket
from collections.abc import Iterator
from urllib.parse import urlsplit

import lcm
import pytest

from gateway.errors import OutputError
from gateway.outputs.lcm.datagrams import NO_CHANNEL, LcmDatagrams, split_datagram
from tests.networks import lcm_url

URL = lcm_url()
GROUP = ("239.255.76.67", urlsplit(URL).port)


@pytest.mark.parametrize(
    ("datagram", "expected"),
    [
        (b"LC02\0\0\0\7CHANNEL\0message\0", ("CHANNEL", b"message\0")),
        (b"LC02\0\0\0\7CHANNEL\0", ("CHANNEL", b"")),
        (b"LC02\0\0\0\7\0x", ("", b"x")),
        (b"LC02\0\0\0\7\xff\0x", ("\ufffd", b"x")),
        (b"LC02\0\0\0\7CHANNEL", None),
        (b"LC02\0\0\0\0", None),
        (b"LC02\0\0", None),
        (b"LC03\0\0\0\7CHANNEL\0message", None),
        (b"", None),
    ],
)
def test_a_datagram_has_a_channel_and_a_message(datagram: bytes, expected: tuple[str, bytes] | None) -> None:
    assert split_datagram(datagram) == expected


@pytest.fixture
def received() -> list[tuple[str, bytes]]:
    return []


@pytest.fixture
def datagrams(received: list[tuple[str, bytes]]) -> Iterator[LcmDatagrams]:
    datagrams = LcmDatagrams(URL, lambda channel, data: received.append((channel, data)))
    yield datagrams
    datagrams.close()


@pytest.mark.netns
def test_it_receives_what_lcm_sends_while_another_program_receives_too(
    datagrams: LcmDatagrams, received: list[tuple[str, bytes]]
) -> None:
    other: list[str] = []
    subscriber = lcm.LCM(URL)
    subscriber.subscribe("NAME", lambda channel, _: other.append(channel))
    lcm.LCM(URL).publish("NAME", b"message")
    while ("NAME", b"message") not in received:  # LCM tests its connection with messages of its own
        datagrams.handle_timeout(5000)
    subscriber.handle_timeout(5000)
    assert other == ["NAME"]


@pytest.mark.netns
def test_what_is_no_message_counts_as_an_empty_one(
    datagrams: LcmDatagrams, received: list[tuple[str, bytes]]
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in (b"", b"nothing of LCM", b"LC02\0\0\0\0NAME"):
            sender.sendto(datagram, GROUP)
            datagrams.handle_timeout(5000)
    datagrams.handle_timeout(1)  # nothing arrives
    assert received == 3 * [(NO_CHANNEL, b"")]


@pytest.mark.netns
@pytest.mark.parametrize(
    ("url", "problem"),
    [
        ("udpm://not-an-address:7721", "udpm://not-an-address:7721 has no multicast address"),
        ("udpm://127.0.0.1:7721", "LCM does not open udpm://127.0.0.1:7721: "),
    ],
)
def test_a_group_that_cannot_be_joined_is_reported_with_the_url(url: str, problem: str) -> None:
    with pytest.raises(OutputError, match=problem) as caught:
        LcmDatagrams(url, lambda _channel, _data: None)
    assert caught.value.cause == "not open"
