"""The server of the page: its address, and what it does not do."""

import socket
from collections.abc import Iterator

import pytest

from gateway.errors import ViewError
from gateway.view.server import ViewServer, address_of, open_server


@pytest.fixture
def server() -> Iterator[ViewServer]:
    server = open_server("127.0.0.1", 0)
    yield server
    server.stop()


def test_a_port_in_use_is_one_sentence_with_the_port_and_the_option() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ViewError, match=rf"^port {port} of 127\.0\.0\.1 is in use .* --port$"):
            open_server("127.0.0.1", port)


def test_a_port_that_was_used_a_moment_ago_can_be_used_again() -> None:
    with socket.create_server(("127.0.0.1", 0)) as former:
        port = former.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)) as client:
            former.accept()[0].close()  # first, so that the port stays in the state TIME_WAIT
            assert client.recv(1) == b""
    open_server("127.0.0.1", port).stop()


@pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid"])
def test_an_address_of_another_computer_is_one_sentence_with_the_option(host: str) -> None:
    with pytest.raises(ViewError, match=f"{host}.*--host"):
        open_server(host, 0)


def test_a_connection_that_is_no_browser_logs_nothing(
    server: ViewServer, caplog: pytest.LogCaptureFixture
) -> None:
    for request in (b"", b"\x16\x03\x01 no HTTP\r\n\r\n"):
        with socket.create_connection(("127.0.0.1", server.get_port())) as connection:
            connection.sendall(request)
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(1000):
                pass
    assert not caplog.records


def test_it_prints_nothing_and_shares_nothing(capfd: pytest.CaptureFixture[str], server: ViewServer) -> None:
    assert server.request_share_url() is None  # type: ignore[func-returns-value]
    server.stop()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("host", "address"),
    [
        ("127.0.0.1", "http://127.0.0.1:8080"),
        ("0.0.0.0", "http://localhost:8080"),  # noqa: S104
        ("::1", "http://[::1]:8080"),
        ("lab-pc", "http://lab-pc:8080"),
    ],
)
def test_the_address_can_be_opened_on_this_computer(host: str, address: str) -> None:
    assert address_of(host, 8080) == address
