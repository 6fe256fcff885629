"""Look-ups of host names: one thread per name, and late answers are kept.

Connections over real sockets; each error says what happened and what to check.
"""

import asyncio
import errno
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import pytest
import uvloop

from gateway.config.settings import SourceSettings
from gateway.errors import ConnectError
from gateway.session import tcp
from gateway.session.process_clock import RunningTimeout
from gateway.session.tcp import MAX_ADDRESSES, is_address, look_up, open_connection, set_socket_options
from tests.support.errors import names
from tests.support.networks import free_port
from tests.unit.session.conftest import Resolver


def num_look_ups(name: str) -> int:
    return sum(thread.name == f"look-up {name}" for thread in threading.enumerate())


async def give_up(name: str) -> None:
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.01):
            await look_up(name)


@pytest.mark.parametrize("host", ["192.0.2.20", "::1", "2001:db8::1", "fe80::1%eth0"])
def test_numbers_are_their_own_addresses(host: str, resolver: Resolver) -> None:
    assert is_address(host)
    assert uvloop.run(look_up(host)) == [host]
    assert resolver.names == []


def test_addresses_keep_their_order_and_are_limited(resolver: Resolver) -> None:
    resolver.addresses = ["127.0.0.9", *(f"127.0.0.{number}" for number in range(1, 20))]
    assert uvloop.run(look_up("many")) == resolver.addresses[:MAX_ADDRESSES]


def test_a_link_local_address_keeps_its_scope(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [(socket.AF_INET6, socket.SOCK_STREAM, 6, "", ("fe80::1", 0, 0, 2))]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    assert uvloop.run(look_up("lab-pc")) == ["fe80::1%2"]


def test_attempts_that_give_up_share_one_look_up(resolver: Resolver) -> None:
    async def attempts() -> None:
        resolver.answers.clear()
        for _ in range(5):
            await give_up("dead")
        await asyncio.gather(*(give_up("dead") for _ in range(5)))
        assert resolver.names == ["dead"]
        assert num_look_ups("dead") == 1

    uvloop.run(attempts())


def test_a_late_answer_serves_the_next_attempt_and_no_other(resolver: Resolver) -> None:
    async def attempts() -> None:
        resolver.answers.clear()
        await give_up("slow")
        resolver.answers.set()
        assert await look_up("slow") == ["127.0.0.1"]
        assert resolver.names == ["slow"]
        assert await look_up("slow") == ["127.0.0.1"]
        assert resolver.names == ["slow", "slow"]

    uvloop.run(attempts())


def test_attempts_at_the_same_time_share_the_answer(resolver: Resolver) -> None:
    async def attempts() -> None:
        first, second = await asyncio.gather(look_up("two"), look_up("two"))
        assert first == second == ["127.0.0.1"]
        assert resolver.names == ["two"]

    uvloop.run(attempts())


def test_an_error_is_not_kept(resolver: Resolver) -> None:
    async def attempts() -> None:
        resolver.error = socket.gaierror(socket.EAI_NONAME, "no")
        with pytest.raises(socket.gaierror):
            await look_up("new")
        resolver.error = None
        assert await look_up("new") == ["127.0.0.1"]

    uvloop.run(attempts())


def test_the_end_of_a_loop_does_not_wait_for_a_look_up(resolver: Resolver) -> None:
    resolver.answers.clear()
    uvloop.run(give_up("dead-at-the-end"))
    assert not resolver.answers.is_set()


@contextmanager
def full_server() -> Iterator[int]:
    """Listen on a port of 127.0.0.1 that answers no further connection; yield the port."""
    with socket.create_server(("127.0.0.1", 0), backlog=0) as server, ExitStack() as clients:
        for _ in range(3):
            client = clients.enter_context(socket.socket())
            client.setblocking(False)
            client.connect_ex(server.getsockname())
        yield server.getsockname()[1]


def source(**settings: Any) -> SourceSettings:
    return SourceSettings(name="lab", **settings)


def error_of(settings: SourceSettings) -> str:
    with pytest.raises(ConnectError) as caught:
        uvloop.run(open_connection(settings, asyncio.Protocol()))
    return str(caught.value)


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
    assert names(error_of(source(host="127.0.0.1", port=port)), "refused", f"127.0.0.1:{port}")


@pytest.mark.parametrize(
    ("raised", "value"),
    [
        (socket.gaierror(socket.EAI_NONAME, "Name or service not known"), "Name or service not known"),
        (OSError(errno.EMFILE, "Too many open files"), "Too many open files"),
        (None, "0.1 s"),
    ],
)
def test_the_error_of_a_name_that_cannot_be_resolved(
    resolver: Resolver, raised: OSError | None, value: str
) -> None:
    resolver.error = raised
    if raised is None:
        resolver.answers.clear()
    timeout_s = 0.1 if raised is None else 60.0
    text = error_of(source(host="labb", port=3020, connect_timeout_s=timeout_s))
    assert names(text, "'labb'", value, "DNS")


@pytest.mark.netns
def test_the_error_of_a_server_that_does_not_answer() -> None:
    with full_server() as port:
        text = error_of(source(host="127.0.0.1", port=port, connect_timeout_s=0.1))
        assert names(text, "no answer", f"127.0.0.1:{port}", "0.1 s")


@pytest.mark.netns
def test_the_error_of_any_other_failure_of_the_network() -> None:
    text = error_of(source(host="192.0.2.20", port=3020))
    assert names(text, "192.0.2.20:3020", os.strerror(errno.ENETUNREACH))


async def connected_address(port: int, timeout_s: float) -> str:
    settings = source(host="lab-pc", port=port, connect_timeout_s=timeout_s)
    transport = await open_connection(settings, asyncio.Protocol())
    address: str = transport.get_extra_info("peername")[0]
    transport.close()
    return address


def test_the_addresses_of_a_name_are_tried_in_turn(resolver: Resolver) -> None:
    resolver.addresses = ["127.0.0.2", "127.0.0.3", "127.0.0.4"]
    with socket.create_server(("127.0.0.3", 0)) as server:
        assert uvloop.run(connected_address(server.getsockname()[1], 20)) == "127.0.0.3"
    assert resolver.names == ["lab-pc"]


def test_an_address_that_does_not_answer_leaves_time_for_the_next(
    resolver: Resolver, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits_s: list[float] = []

    def noted(seconds: float) -> Any:
        limits_s.append(seconds)
        return RunningTimeout(seconds)

    monkeypatch.setattr(tcp, "RunningTimeout", noted)
    resolver.addresses = ["127.0.0.1", "127.0.0.3"]
    with full_server() as port, socket.create_server(("127.0.0.3", port)):
        assert uvloop.run(connected_address(port, 0.4)) == "127.0.0.3"
    assert limits_s[1] <= 0.2  # half of the time


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
            while sent <= 2_500_000:
                sent += server.send(bytes(2252))
        assert sent > 2_500_000
        assert client.getsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT) == 1
