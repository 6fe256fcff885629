"""The VRPN server with real sockets: clients, requests by UDP, pings, and what it refuses."""

import asyncio
import contextlib
import errno
import logging
import os
import socket
from collections.abc import AsyncIterator
from dataclasses import replace

import pytest
import pytest_asyncio

from gateway.outputs.adapters.vrpn.protocol import encode_pose
from gateway.outputs.adapters.vrpn.server import (
    LIMITS,
    MAX_CALLS,
    MAX_CALLS_PER_HOST,
    CallbackRequests,
    VrpnServer,
    bind,
)
from gateway.runtime.failures import EventLog
from gateway.runtime.token_bucket import TokenBucket
from tests.support.errors import names
from tests.support.networks import free_port
from tests.support.records import levels
from tests.support.vrpn_client import COOKIE, Pose, VrpnClient, send_datagram
from tests.support.waiting import wait_until_async

POSE = (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0, 0.0)
ONE = encode_pose(0, 0, POSE)
OWN_PORT = 3883

Running = tuple[VrpnServer, int]


@contextlib.asynccontextmanager
async def serving(port: int) -> AsyncIterator[VrpnServer]:
    server = VrpnServer("127.0.0.1", port, "auto")
    server.trackers.set_tools("lab", ["wand", "Left Foot"])
    task = asyncio.create_task(server.serve())
    try:
        yield server
    finally:
        await server.close()
        assert task.done()


@pytest_asyncio.fixture
async def running(caplog: pytest.LogCaptureFixture) -> AsyncIterator[Running]:
    caplog.set_level(logging.INFO)
    port = free_port()
    async with serving(port) as server:
        await wait_until_async(lambda: not server.problem)
        yield server, port


async def ready(server: VrpnServer, count: int) -> None:
    await wait_until_async(lambda: len(server.clients.served) == count)


# Requests by UDP ----------------------------------------------------------------------------


async def test_calls_are_bounded_for_each_host_and_in_all() -> None:
    """Anybody can forge a sender, so the gateway must not become a tool of an attack."""
    called: list[tuple[str, int]] = []
    may_end = asyncio.Event()

    async def call(host: str, port: int) -> None:
        called.append((host, port))
        await may_end.wait()

    async def request_callback(host: str, port: object) -> None:
        requests._receive(f"{host} {port}".encode() + b"\0", host)
        await asyncio.sleep(0)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.setblocking(False)
        requests = CallbackRequests(udp, call, EventLog(logging.getLogger(__name__), "vrpn"), OWN_PORT)
        for port in (OWN_PORT, "HTTP"):
            await request_callback("192.0.2.1", port)
        for number in range(5000, 5000 + MAX_CALLS_PER_HOST + 1):
            for _ in range(2):  # a repeated request is none
                await request_callback("192.0.2.1", number)
        assert called == [("192.0.2.1", 5000 + number) for number in range(MAX_CALLS_PER_HOST)]
        for number in range(MAX_CALLS):
            await request_callback(f"192.0.2.{100 + number}", 5000)
        assert len(called) == MAX_CALLS
        may_end.set()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        await request_callback("192.0.2.1", 5000)  # there is room again
        assert called[MAX_CALLS:] == [("192.0.2.1", 5000)]
        requests.close()


async def test_client_is_called_back_at_its_own_address(running: Running) -> None:
    server, port = running
    # libvrpn may send a wrong address, for example that of another network card.
    async with await VrpnClient.request_callback(port, host_in_message="192.0.2.1") as client:
        await wait_until_async(lambda: client.trackers)
        assert client.cookie == COOKIE
        server.send(ONE)
        await wait_until_async(lambda: client.poses)


async def test_only_the_address_that_asks_is_called_back(running: Running) -> None:
    with (
        socket.create_server(("127.0.0.2", 0)) as asker,
        socket.create_server(("127.0.0.3", asker.getsockname()[1])) as stranger,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp,
    ):
        udp.bind(("127.0.0.2", 0))
        udp.sendto(f"127.0.0.3 {asker.getsockname()[1]}\0".encode(), ("127.0.0.1", running[1]))
        connection, _ = await asyncio.to_thread(asker.accept)
        connection.close()
        stranger.setblocking(False)
        with pytest.raises(BlockingIOError):
            stranger.accept()


async def test_refused_calls_are_logged_few_times(running: Running, caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(20):
        send_datagram(f"127.0.0.1 {free_port()}\0".encode(), running[1])
    async with await VrpnClient.request_callback(running[1]) as client:
        await wait_until_async(lambda: client.trackers)
    refused = [text for text in caplog.messages if "asked by UDP" in text]
    assert 1 <= len(refused) <= 5
    assert "Connection refused" in refused[0]


async def test_flood_of_udp_calls_is_read_slowly(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[bytes] = []
    monkeypatch.setattr("gateway.outputs.adapters.vrpn.server.callback_port", read.append)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        for _ in range(3000):
            udp.sendto(b"127.0.0.1 5000\0", ("127.0.0.1", running[1]))
    async with await VrpnClient.connect(running[1]) as client:
        await wait_until_async(lambda: client.trackers)
    assert len(read) < 200


# Clients ------------------------------------------------------------------------------------


async def test_each_client_gets_cookie_and_descriptions_then_poses_until_it_goes(running: Running) -> None:
    server, port = running
    async with await VrpnClient.connect(port) as first, await VrpnClient.connect(port) as second:
        await ready(server, 2)
        assert server.send(encode_pose(1, 1_700_000_000_000_123, POSE)) == []
        for client in (first, second):
            await wait_until_async(lambda client=client: client.poses)  # type: ignore[misc]
            assert client.cookie == COOKIE
            assert client.trackers == {0: "wand", 1: "Left_Foot"}
            assert client.types == {0: "vrpn_Tracker Pos_Quat", 1: "vrpn_Base pong_message"}
            assert client.poses == [Pose("Left_Foot", 1_700_000_000_000_123, 0, POSE[:7])]
    await wait_until_async(lambda: not server.has_clients)
    assert server.send(ONE) == []


async def test_pings_of_present_tools_are_answered_under_the_trackers_own_number(running: Running) -> None:
    server, port = running
    async with await VrpnClient.connect(port) as client:
        client.describe("VRPN Control", "Left_Foot", "wand", "probe")
        for number in (2, 3, 1):
            client.ping(number)
        await wait_until_async(lambda: len(client.pongs) == 2)
        server.trackers.set_tools("lab", ["wand", "probe"])
        client.ping(3)
        await wait_until_async(lambda: len(client.pongs) == 3)
        assert client.pongs == ["wand", "Left_Foot", "probe"]


async def test_tools_with_new_names_or_numbers_are_described_before_their_poses(running: Running) -> None:
    server, port = running
    async with await VrpnClient.connect(port) as client:
        await wait_until_async(lambda: len(client.described) == 2)
        server.trackers.set_tools("lab", ["hand", "Left Foot", "probe"])
        numbers = {tracker.name: tracker.number for tracker in server.trackers.by_name.values()}
        server.send(encode_pose(numbers["probe"], 0, POSE) + encode_pose(numbers["hand"], 0, POSE))
        server.trackers.remove("lab")
        server.trackers.set_tools("stage", ["foot"])
        server.send(ONE)
        await wait_until_async(lambda: len(client.poses) == 3)
        assert [pose.name for pose in client.poses] == ["probe", "hand", "foot"]
        assert client.described == ["wand", "Left_Foot", "hand", "probe", "foot"]


# Limits -------------------------------------------------------------------------------------


async def test_slow_client_misses_its_own_poses_only(running: Running) -> None:
    server, port = running
    with socket.socket() as slow:
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.connect(("127.0.0.1", port))
        slow.sendall(COOKIE)
        slow_name = f"127.0.0.1:{slow.getsockname()[1]}"
        async with await VrpnClient.connect(port) as client:
            await ready(server, 2)
            batch = ONE * 100
            num_sent = 0
            while slow_name not in (missed := server.send(batch)):
                assert missed == []
                num_sent += 1
                await wait_until_async(lambda: len(client.poses) == 100 * num_sent)  # noqa: B023 - waits here
                assert num_sent < 1000  # 8.8 MB
            server.send(batch)
            await wait_until_async(lambda: len(client.poses) == 100 * (num_sent + 2))
        slow.setblocking(False)

        def reads_again() -> bool:
            with contextlib.suppress(BlockingIOError):
                slow.recv(65536)
            return not server.send(encode_pose(1, 0, POSE))

        await wait_until_async(reads_again)
        assert [client._timeout for client in server.clients] == [None]  # so it stays connected


async def test_client_that_stops_reading_is_disconnected(
    running: Running, caplog: pytest.LogCaptureFixture
) -> None:
    server, port = running
    with socket.create_connection(("127.0.0.1", port)) as slow:
        slow.sendall(COOKIE)
        await ready(server, 1)
        server.clients.limits = replace(LIMITS, unread_s=0.05)  # not for the system, which is asked before
        await wait_until_async(lambda: server.send(ONE * 1000))
        await ready(server, 0)
    assert names(caplog.text, "nothing for 0.05 s")


@pytest.mark.parametrize(
    ("begin", "value"),
    [
        (b"vrpn: ver. 07", "0.05 s"),
        (b"GET / HTTP/1.1\r\n\r\n", "VRPN 07"),
        (COOKIE + b"\xff" * 24, "4294967295 bytes"),
    ],
)
async def test_client_that_breaks_the_protocol_is_disconnected(
    running: Running, caplog: pytest.LogCaptureFixture, begin: bytes, value: str
) -> None:
    server, port = running
    server.clients.limits = replace(LIMITS, handshake_s=0.05)
    async with await VrpnClient.connect(port, begin) as client:
        await wait_until_async(lambda: client.has_ended)
    assert names(caplog.text, value)
    await wait_until_async(lambda: not server.clients)


async def test_oldest_handshake_makes_room_for_a_new_one(running: Running) -> None:
    server, port = running
    async with contextlib.AsyncExitStack() as stack:
        waiting = [
            await stack.enter_async_context(await VrpnClient.connect(port, b""))
            for _ in range(LIMITS.handshakes or 0)
        ]
        await wait_until_async(lambda: len(server.clients) == LIMITS.handshakes)
        async with await VrpnClient.connect(port) as client:
            await wait_until_async(lambda: client.trackers and waiting[0].has_ended)
            assert not waiting[1].has_ended


async def test_number_of_clients_is_bounded(running: Running, caplog: pytest.LogCaptureFixture) -> None:
    server, port = running
    server.clients.limits = replace(LIMITS, clients=2)
    async with await VrpnClient.connect(port):
        async with await VrpnClient.connect(port):
            await ready(server, 2)
            async with await VrpnClient.connect(port) as third:
                await wait_until_async(lambda: third.has_ended)
        assert names(caplog.text, "2 clients")
        await ready(server, 1)
        async with await VrpnClient.connect(port) as third:
            await wait_until_async(lambda: third.trackers)


async def test_flood_of_pings_is_read_slowly(running: Running) -> None:
    server, port = running
    server.clients.limits = replace(LIMITS, received_burst_bytes=8192.0)
    async with await VrpnClient.connect(port) as flood, await VrpnClient.connect(port) as client:
        await wait_until_async(lambda: client.trackers)
        flood.describe("wand")
        for _ in range(10_000):
            flood.ping(0)
        client.describe("wand")
        client.ping(0)
        await wait_until_async(lambda: client.pongs)
        assert len(flood.pongs) < 2_000
        server.send(ONE)
        await wait_until_async(lambda: client.poses and flood.poses)


async def test_connections_are_accepted_slowly(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    server, port = running
    async with contextlib.AsyncExitStack() as stack:
        first = await stack.enter_async_context(await VrpnClient.connect(port))
        await wait_until_async(lambda: first.trackers)
        # The server waits for a connection already, then only two more are allowed.
        monkeypatch.setattr(server, "_accepts", TokenBucket(0.0, 2.0))
        clients = [await stack.enter_async_context(await VrpnClient.connect(port)) for _ in range(10)]
        await wait_until_async(lambda: clients[2].trackers)
        first.describe("wand")
        for count in range(1, 20):
            first.ping(0)
            await wait_until_async(lambda count=count: len(first.pongs) == count)  # type: ignore[misc]
        assert len(server.clients) == 1 + 3
        monkeypatch.setattr(server, "_accepts", TokenBucket(1000.0))
        await wait_until_async(lambda: all(client.trackers for client in clients))


# The port -----------------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", ["TCP", "UDP"])
async def test_port_in_use_is_a_problem_until_it_is_free(
    protocol: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    port = free_port()
    kind = {"TCP": socket.SOCK_STREAM, "UDP": socket.SOCK_DGRAM}[protocol]
    async with contextlib.AsyncExitStack() as stack:
        with socket.socket(socket.AF_INET, kind) as other:
            other.bind(("127.0.0.1", port))
            if protocol == "TCP":
                other.listen()
            server = await stack.enter_async_context(serving(port))
            await wait_until_async(lambda: names(server.problem, os.strerror(errno.EADDRINUSE)))
            assert names(server.problem, f"127.0.0.1, {protocol} port {port}", "vrpn.port")
        await wait_until_async(lambda: not server.problem)
        async with await VrpnClient.connect(port):
            await ready(server, 1)
    assert levels(caplog) == ["WARNING"]
    assert any(names(message, "served", f"127.0.0.1, port {port}") for message in caplog.messages)


def test_addresses_of_ipv4_come_first() -> None:
    """A name such as localhost means both, and libvrpn sends its requests over IPv4."""
    addresses = [socket.getaddrinfo(host, 0, type=socket.SOCK_DGRAM)[0] for host in ("::1", "127.0.0.1")]
    with bind(addresses, socket.SOCK_DGRAM) as bound:
        assert bound.getsockname()[0] == "127.0.0.1"
