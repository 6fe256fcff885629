"""Connections over real sockets; each error says what happened and what to check."""

import asyncio
import errno
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest
import uvloop

from gateway.config.settings import SourceSettings
from gateway.errors import ConnectError
from gateway.stream.tcp import open_connection, set_socket_options
from tests.networks import free_port


def source(**settings: Any) -> SourceSettings:
    return SourceSettings(name="lab", **settings)


def error_of(settings: SourceSettings) -> str:
    with pytest.raises(ConnectError) as caught:
        uvloop.run(open_connection(settings, asyncio.Protocol()))
    return str(caught.value)


@pytest.fixture
def answer_to_lookups(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Make every name look-up wait for this event."""
    answer = threading.Event()
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_: answer.wait(60))
    yield answer
    answer.set()


def test_the_protocol_gets_the_connection_and_the_transport_is_returned() -> None:
    class Greeter(asyncio.Protocol):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            self.transport = transport

    async def connect(port: int) -> bytes:
        protocol = Greeter()
        transport = await open_connection(source(host="127.0.0.2", port=port), protocol)
        assert protocol.transport is transport
        accepted, _ = await asyncio.to_thread(server.accept)
        transport.write(b"Version 1.0")
        with accepted:
            received = await asyncio.to_thread(accepted.recv, 11)
        transport.close()
        return received

    with socket.create_server(("127.0.0.2", 0)) as server:
        assert uvloop.run(connect(server.getsockname()[1])) == b"Version 1.0"


def test_the_error_of_a_port_without_a_server() -> None:
    port = free_port()
    assert error_of(source(host="127.0.0.1", port=port)) == (
        f"connection refused by 127.0.0.1:{port}; is the RT server running, and is this its port?"
    )


def test_the_error_of_an_unknown_host_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", fail)
    assert error_of(source(host="labb", port=3020)) == (
        "host name 'labb' is not known (Name or service not known); check sources.host and DNS"
    )


def test_the_error_of_a_time_out(answer_to_lookups: threading.Event) -> None:
    async def connect() -> str:
        with pytest.raises(ConnectError) as caught:
            await open_connection(source(host="lab-pc", port=3020, connect_timeout_s=0.1), asyncio.Protocol())
        answer_to_lookups.set()
        return str(caught.value)

    assert uvloop.run(connect()) == (
        "no answer from lab-pc:3020 within 0.1 s; "
        "is the computer on and reachable, and its firewall open for this port?"
    )


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (OSError(errno.ENETUNREACH, "Network is unreachable"), "Network is unreachable"),
        (OSError("no text of the system"), "no text of the system"),
    ],
)
def test_the_error_of_any_other_failure_of_the_network(
    error: OSError, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(socket, "getaddrinfo", fail)
    assert error_of(source(host="192.0.2.20", port=3020)) == (
        f"no connection to 192.0.2.20:3020: {reason}; check address, cable and routing"
    )


def test_the_host_and_the_port_are_looked_up(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[object, ...]] = []

    def look_up(*arguments: object) -> None:
        asked.append(arguments)
        raise socket.gaierror(socket.EAI_NONAME, "no")

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    error_of(source(host="lab-pc", port=3030))
    assert asked == [("lab-pc", 3030)]


def test_the_kernel_holds_seconds_of_frames_while_the_process_stands_still() -> None:
    """The server has a small send buffer, as on Windows, and the client reads nothing."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 64 * 1024)
        client = socket.create_connection(listener.getsockname())
        server, _ = listener.accept()
    with client, server:
        set_socket_options(client)
        server.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        server.settimeout(1)
        sent = 0
        with suppress(TimeoutError):
            while sent < 10_000_000:
                sent += server.send(bytes(2252))
        assert sent > 2_500_000
        assert client.getsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT) == 1
