"""URLs of LCM, connections with it, and datagrams that are received without LCM's library."""

import os
import socket
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import lcm
import pytest

from gateway.errors import OutputError
from gateway.outputs.lcm import connection
from gateway.outputs.lcm.connection import Waiting, open_lcm, receiving_url
from gateway.outputs.lcm.receiver import joined_socket, split_datagram
from tests.support.errors import raises
from tests.support.lcm_relay import LcmRelay
from tests.support.networks import lcm_url
from tests.support.waiting import wait_until

URL = lcm_url()
GROUP = ("239.255.76.67", urlsplit(URL).port)


@pytest.mark.parametrize(
    ("allowed", "url", "option"),
    [
        (212992, "udpm://239.255.76.67:7667?ttl=0", "&recv_buf_size=212992"),
        (212992, "udpm://", "?recv_buf_size=212992"),
        (2**23, "udpm://", "?recv_buf_size=4194304"),
        (None, "udpm://", ""),
        *((212992, url, "") for url in ("udpm://?recv_buf_size=1000", "memq://", "tcpq://host:7700")),
    ],
)
def test_a_multicast_subscriber_gets_as_large_a_buffer_as_the_kernel_allows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, allowed: int | None, url: str, option: str
) -> None:
    """Up to 4 MiB. Without a known limit, the kernel decides; a size in the URL and other schemes stay."""
    path = tmp_path / "rmem_max"
    monkeypatch.setattr(connection, "_RMEM_MAX", path)
    if allowed is not None:
        path.write_text(f"{allowed}\n")
    assert receiving_url(url) == url + option


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1"])
def test_a_relay_is_found_by_its_name(host: str) -> None:
    relay = LcmRelay()
    connection = open_lcm(relay.url.replace("127.0.0.1", host))
    connection.subscribe("NAME", lambda *_: None)
    wait_until(lambda: "NAME" in relay.subscribed)
    relay.close()


@pytest.mark.netns
def test_a_name_that_is_not_known_does_not_mean_this_computer() -> None:
    relay = LcmRelay()
    url = relay.url.replace("127.0.0.1", "nowhere.invalid")
    with raises(OutputError, "'nowhere.invalid'", url, "DNS", cause="not open"):
        open_lcm(url)
    relay.close()


def test_a_pipe_of_another_thread_is_not_kept_open() -> None:
    """Whoever reads it waits until every copy of the other end is closed, as subprocess does."""
    reading, writing = os.pipe()
    try:
        with pytest.raises(OSError, match="non-socket"):
            connection._set_up_to_send(writing)
        os.close(writing)
        os.set_blocking(reading, False)
        assert os.read(reading, 1) == b""
    finally:
        os.close(reading)


def test_a_tcp_socket_of_another_thread_still_waits() -> None:
    with socket.socket() as tcp:
        connection._set_up_to_send(tcp.fileno())
        assert os.get_blocking(tcp.fileno())


# Datagrams --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("datagram", "expected"),
    [
        (b"LC02\0\0\0\7CHANNEL\0message\0", ("CHANNEL", b"message\0")),
        (b"LC02\0\0\0\7CHANNEL\0", ("CHANNEL", b"")),
        (b"LC02\0\0\0\7\0x", ("", b"x")),
        (b"LC02\0\0\0\7\xff\0x", ("\ufffd", b"x")),
        *((b"LC02\0\0\0" + end, ("", b"")) for end in (b"\7CHANNEL", b"\0", b"")),
        (b"LC03\0\0\0\7CHANNEL\0message", ("", b"")),
        (b"", ("", b"")),
    ],
)
def test_a_datagram_has_a_channel_and_a_message_or_counts_as_an_empty_one(
    datagram: bytes, expected: tuple[str, bytes]
) -> None:
    assert split_datagram(datagram) == expected


@pytest.fixture
def joined() -> Iterator[socket.socket]:
    with joined_socket(URL) as joined:
        joined.settimeout(5)
        yield joined


@pytest.mark.netns
def test_it_receives_what_lcm_sends_while_another_program_receives_too(joined: socket.socket) -> None:
    other: list[str] = []
    subscriber = lcm.LCM(URL)
    subscriber.subscribe("NAME", lambda channel, _: other.append(channel))
    lcm.LCM(URL).publish("NAME", b"message")
    while split_datagram(joined.recv(100)) != ("NAME", b"message"):
        pass  # LCM tests its connection with messages of its own
    subscriber.handle_timeout(5000)
    assert other == ["NAME"]


@pytest.mark.netns
def test_what_is_not_sent_to_the_group_is_not_received(joined: socket.socket) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b"LC02\0\0\0\0NAME\0", ("127.0.0.1", GROUP[1]))
        sender.sendto(b"", GROUP)
    assert joined.recv(100) == b""


@pytest.mark.netns
def test_the_wait_for_messages_ends_when_one_arrives_when_woken_and_when_the_connection_is_closed(
    joined: socket.socket,
) -> None:
    """So the thread costs nothing while nobody asks, and does not delay the end."""
    waiting = Waiting()
    for _ in range(1000):
        waiting.wake()  # more often than the thread reads, and before it waits
    assert not waiting.wait(joined)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b"datagram", GROUP)
    while not waiting.wait(joined):
        pass  # wakes that are left
    joined.close()
    with pytest.raises(OSError, match="not connected"):
        waiting.wait(joined)
    waiting.close()
    waiting.wake()


@pytest.mark.netns
@pytest.mark.parametrize("url", ["udpm://not-an-address:7721", "udpm://127.0.0.1:7721"])
def test_a_group_that_cannot_be_joined_is_reported_with_the_url(url: str) -> None:
    with raises(OutputError, url, "lcm.url", cause="not open"):
        joined_socket(url)
