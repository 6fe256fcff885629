"""The VRPN server with real sockets: clients, requests by UDP, pings, and what it refuses."""

import asyncio
import contextlib
import logging
import socket
from collections.abc import AsyncIterator

import pytest
import pytest_asyncio

from gateway.outputs.vrpn import client as client_module
from gateway.outputs.vrpn import server as server_module
from gateway.outputs.vrpn.protocol import encode_pose
from gateway.outputs.vrpn.server import MAX_CLIENTS, MAX_HANDSHAKES, VrpnServer
from gateway.outputs.vrpn.sockets import bind
from gateway.token_bucket import TokenBucket
from tests.networks import free_port
from tests.vrpn_client import COOKIE, Pose, VrpnClient, description, message, send_datagram
from tests.waiting import wait_until_async

POSE = (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0, 0.0)


@contextlib.asynccontextmanager
async def running_server(port: int | None = None) -> AsyncIterator[tuple[VrpnServer, int]]:
    port = port or free_port()
    server = VrpnServer("127.0.0.1", port, "auto")
    server.trackers.set_tools("lab", ["wand", "Left Foot"])
    serving = asyncio.create_task(server.serve())
    try:
        await wait_until_async(lambda: not server.problem)
        yield server, port
    finally:
        await server.close()
        assert serving.done()


@pytest_asyncio.fixture
async def running() -> AsyncIterator[tuple[VrpnServer, int]]:
    async with running_server() as both:
        yield both


Running = tuple[VrpnServer, int]


async def test_client_gets_cookie_and_descriptions_then_poses(running: Running) -> None:
    server, port = running
    async with await VrpnClient.connect(port) as client:
        await wait_until_async(lambda: server.has_clients)
        assert server.send(encode_pose(1, 1_700_000_000_000_123, POSE)) == []
        await wait_until_async(lambda: client.poses)
        assert client.cookie == COOKIE
        assert client.trackers == {0: "wand", 1: "Left_Foot"}
        assert client.types == {0: "vrpn_Tracker Pos_Quat", 1: "vrpn_Base pong_message"}
        assert client.poses == [Pose("Left_Foot", 1_700_000_000_000_123, 0, POSE[:7])]


async def test_client_that_disconnects_is_forgotten(running: Running) -> None:
    server, port = running
    async with await VrpnClient.connect(port):
        await wait_until_async(lambda: server.has_clients)
    await wait_until_async(lambda: not server.has_clients)
    assert server.send(encode_pose(0, 0, POSE)) == []


async def test_several_clients_get_the_same(running: Running) -> None:
    server, port = running
    clients = [await VrpnClient.connect(port) for _ in range(5)]
    await wait_until_async(lambda: len(server._ready) == 5)
    server.send(encode_pose(0, 0, POSE))
    await wait_until_async(lambda: all(client.poses for client in clients))
    for client in clients:
        await client.close()


async def test_client_is_called_back_at_its_own_address(running: Running) -> None:
    server, port = running
    # libvrpn may send a wrong address, for example that of another network card.
    async with await VrpnClient.knock(port, host_in_message="192.0.2.1") as client:
        await wait_until_async(lambda: client.trackers)
        assert client.cookie == COOKIE
        server.send(encode_pose(0, 0, POSE))
        await wait_until_async(lambda: client.poses)


async def test_only_the_address_that_asks_is_called_back(running: Running) -> None:
    _, port = running
    with (
        socket.create_server(("127.0.0.2", 0)) as asker,
        socket.create_server(("127.0.0.3", asker.getsockname()[1])) as stranger,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp,
    ):
        udp.bind(("127.0.0.2", 0))
        udp.sendto(f"127.0.0.3 {asker.getsockname()[1]}\0".encode(), ("127.0.0.1", port))
        connection, _ = await asyncio.to_thread(asker.accept)
        connection.close()
        stranger.setblocking(False)
        with pytest.raises(BlockingIOError):
            stranger.accept()


async def test_repeated_request_does_not_connect_twice(running: Running) -> None:
    server, port = running
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setblocking(False)
        own_port = listener.getsockname()[1]
        for _ in range(5):
            send_datagram(f"127.0.0.1 {own_port}\0".encode(), port)
        async with await VrpnClient.knock(port) as client:  # the server has read the five requests
            await wait_until_async(lambda: client.trackers)
        listener.accept()[0].close()
        with pytest.raises(BlockingIOError):
            listener.accept()
    assert server.problem == ""


@pytest.mark.parametrize("text", ["127.0.0.1 {own}", "127.0.0.1 22", "127.0.0.1", "GET / HTTP/1.1", ""])
async def test_other_requests_by_udp_are_ignored(running: Running, text: str) -> None:
    server, port = running
    send_datagram(text.format(own=port).encode() + b"\0", port)
    async with await VrpnClient.knock(port) as client:
        await wait_until_async(lambda: client.trackers)
        assert len(server._clients) == 1


async def test_call_that_is_refused_is_logged_few_times(
    running: Running, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    _, port = running
    for _ in range(20):
        send_datagram(f"127.0.0.1 {free_port()}\0".encode(), port)
    async with await VrpnClient.knock(port) as client:
        await wait_until_async(lambda: client.trackers)
    refused = [text for text in caplog.messages if "asked by UDP" in text]
    assert 1 <= len(refused) <= 5
    assert "Connection refused" in refused[0]


async def test_flood_of_requests_by_udp_is_read_slowly(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, port = running
    num_read = 0

    def knock_port(_datagram: bytes) -> None:
        nonlocal num_read
        num_read += 1

    monkeypatch.setattr("gateway.outputs.vrpn.knocks.knock_port", knock_port)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        for _ in range(3000):
            udp.sendto(b"127.0.0.1 5000\0", ("127.0.0.1", port))
    async with await VrpnClient.connect(port) as client:
        await wait_until_async(lambda: client.trackers)
    assert num_read < 200


async def test_ping_is_answered_under_the_trackers_own_number(running: Running) -> None:
    _, port = running
    async with await VrpnClient.connect(port) as client:
        client.describe("VRPN Control", "Left_Foot", "wand", "ghost")
        client.ping(2)
        client.ping(3)
        client.ping(1)
        await wait_until_async(lambda: len(client.pongs) == 2)
        assert client.pongs == ["wand", "Left_Foot"]


async def test_ping_is_answered_once_the_tool_is_there(running: Running) -> None:
    server, port = running
    async with await VrpnClient.connect(port) as client:
        client.describe("probe")
        client.ping(0)
        await wait_until_async(lambda: server.has_clients)
        server.trackers.set_tools("lab", ["wand", "probe"])
        client.ping(0)
        await wait_until_async(lambda: client.pongs)
        assert client.pongs == ["probe"]


async def test_new_and_renamed_tools_are_described_before_their_poses(running: Running) -> None:
    server, port = running
    async with await VrpnClient.connect(port) as client:
        await wait_until_async(lambda: len(client.described) == 2)
        server.trackers.set_tools("lab", ["hand", "Left Foot", "probe"])
        numbers = {tracker.name: tracker.number for tracker in server.trackers.current}
        server.send(encode_pose(numbers["probe"], 0, POSE) + encode_pose(numbers["hand"], 0, POSE))
        await wait_until_async(lambda: len(client.poses) == 2)
        assert [pose.name for pose in client.poses] == ["probe", "hand"]
        assert client.described == ["wand", "Left_Foot", "hand", "probe"]


async def test_number_that_is_used_again_is_described_again(running: Running) -> None:
    server, port = running
    async with await VrpnClient.connect(port) as client:
        await wait_until_async(lambda: len(client.described) == 2)
        server.trackers.remove("lab")
        server.trackers.set_tools("stage", ["foot"])
        server.send(encode_pose(0, 0, POSE))
        await wait_until_async(lambda: client.poses)
        assert client.poses[0].name == "foot"


async def test_slow_client_misses_its_own_poses_only(running: Running) -> None:
    server, port = running
    with socket.socket() as slow:
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.connect(("127.0.0.1", port))
        slow.sendall(COOKIE)
        slow_name = f"127.0.0.1:{slow.getsockname()[1]}"
        async with await VrpnClient.connect(port) as client:
            await wait_until_async(lambda: len(server._ready) == 2)
            batch = encode_pose(0, 0, POSE) * 100
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


async def test_client_that_stops_reading_is_disconnected(
    running: Running, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(client_module, "UNREAD_TIMEOUT_S", 0.05)
    server, port = running
    with socket.create_connection(("127.0.0.1", port)) as slow:
        slow.sendall(COOKIE)
        await wait_until_async(lambda: server.has_clients)
        batch = encode_pose(0, 0, POSE) * 1000
        await wait_until_async(lambda: server.send(batch))
        await wait_until_async(lambda: not server.has_clients)
    assert "it has read nothing for 0.05 s" in caplog.text


async def test_half_open_connection_is_closed(
    running: Running, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(client_module, "HANDSHAKE_TIMEOUT_S", 0.05)
    _, port = running
    async with await VrpnClient.connect(port, b"vrpn: ver. 07") as client:
        await wait_until_async(lambda: client.has_ended)
    assert "it sent no VRPN cookie within 0.05 s" in caplog.text


@pytest.mark.parametrize(
    ("begin", "text"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", "it does not speak VRPN 07"),
        (COOKIE + b"\xff" * 24, "a message of 4294967295 bytes"),
        (COOKIE + message(0, -1, bytes(101)), "a description of 101 bytes"),
        (COOKIE + description(5000, -1, "wand"), "it describes number 5000"),
    ],
)
async def test_client_that_breaks_the_protocol_is_disconnected(
    running: Running, caplog: pytest.LogCaptureFixture, begin: bytes, text: str
) -> None:
    caplog.set_level(logging.INFO)
    server, port = running
    async with await VrpnClient.connect(port, begin) as client:
        await wait_until_async(lambda: client.has_ended)
    assert text in caplog.text
    await wait_until_async(lambda: not server._clients)


async def test_oldest_handshake_makes_room_for_a_new_one(running: Running) -> None:
    server, port = running
    waiting = [await VrpnClient.connect(port, b"") for _ in range(MAX_HANDSHAKES)]
    await wait_until_async(lambda: len(server._clients) == MAX_HANDSHAKES)
    async with await VrpnClient.connect(port) as client:
        await wait_until_async(lambda: client.trackers)
        await wait_until_async(lambda: waiting[0].has_ended)
        assert not waiting[1].has_ended
    for other in waiting:
        await other.close()


async def test_number_of_clients_is_bounded(
    running: Running, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(server_module, "MAX_CLIENTS", 2)
    server, port = running
    clients = [await VrpnClient.connect(port) for _ in range(2)]
    await wait_until_async(lambda: len(server._ready) == 2)
    async with await VrpnClient.connect(port) as third:
        await wait_until_async(lambda: third.has_ended)
    assert "is refused: 2 clients are connected" in caplog.text
    await clients[0].close()
    await wait_until_async(lambda: len(server._ready) == 1)
    async with await VrpnClient.connect(port) as third:
        await wait_until_async(lambda: third.trackers)
    await clients[1].close()
    assert MAX_CLIENTS >= 32


async def test_flood_of_pings_is_read_slowly(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_module, "_READ_BURST_BYTES", 8192.0)
    server, port = running
    async with await VrpnClient.connect(port) as flood, await VrpnClient.connect(port) as client:
        await wait_until_async(lambda: client.trackers)
        flood.describe("wand")
        for _ in range(10_000):
            flood.ping(0)
        client.describe("wand")
        client.ping(0)
        await wait_until_async(lambda: client.pongs)
        assert len(flood.pongs) < 2_000
        server.send(encode_pose(0, 0, POSE))
        await wait_until_async(lambda: client.poses and flood.poses)


async def test_connections_are_accepted_at_a_limited_rate(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    server, port = running
    async with await VrpnClient.connect(port) as first:
        await wait_until_async(lambda: first.trackers)
        # The server waits for a connection already, then only two more are allowed.
        monkeypatch.setattr(server, "_accepts", TokenBucket(0.0, 2.0))
        clients = [await VrpnClient.connect(port) for _ in range(10)]
        await wait_until_async(lambda: clients[2].trackers)
        first.describe("wand")
        for count in range(1, 20):
            first.ping(0)
            await wait_until_async(lambda count=count: len(first.pongs) == count)  # type: ignore[misc]
        assert len(server._clients) == 1 + 3
        monkeypatch.setattr(server, "_accepts", TokenBucket(1000.0))
        await wait_until_async(lambda: all(client.trackers for client in clients))
    for client in clients:
        await client.close()


@pytest.mark.parametrize("kind", [socket.SOCK_STREAM, socket.SOCK_DGRAM])
async def test_port_in_use_is_a_problem_until_it_is_free(
    kind: socket.SocketKind, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(server_module, "_RETRY_S", 0.02)
    port = free_port()
    protocol = {socket.SOCK_STREAM: "TCP", socket.SOCK_DGRAM: "UDP"}[kind]
    server = VrpnServer("127.0.0.1", port, "auto")
    with socket.socket(socket.AF_INET, kind) as other:
        other.bind(("127.0.0.1", port))
        if kind is socket.SOCK_STREAM:
            other.listen()
        serving = asyncio.create_task(server.serve())
        await wait_until_async(lambda: "Address already in use" in server.problem)
        assert server.problem.startswith(f"cannot listen on 127.0.0.1, {protocol} port {port}: ")
        assert "; stop the program that uses the port" in server.problem
    await wait_until_async(lambda: not server.problem)
    async with await VrpnClient.connect(port):
        await wait_until_async(lambda: server.has_clients)
    await server.close()
    assert serving.done()
    assert caplog.text.count("WARNING") == 1
    assert f"trackers are served on 127.0.0.1, port {port}" in caplog.text


async def test_host_of_another_computer_is_a_problem() -> None:
    server = VrpnServer("192.0.2.1", free_port(), "auto")
    serving = asyncio.create_task(server.serve())
    await wait_until_async(lambda: "cannot listen on 192.0.2.1" in server.problem)
    await server.close()
    assert serving.done()


async def test_name_of_this_computer_means_its_ipv4_address() -> None:
    port = free_port()
    server = VrpnServer("localhost", port, "auto")
    serving = asyncio.create_task(server.serve())
    await wait_until_async(lambda: not server.problem)
    async with await VrpnClient.knock(port) as client:  # on 127.0.0.1
        await wait_until_async(lambda: client.types)
    await server.close()
    assert serving.done()


def test_addresses_of_ipv4_come_first() -> None:
    six = socket.getaddrinfo("::1", 0, type=socket.SOCK_DGRAM)
    four = socket.getaddrinfo("127.0.0.1", 0, type=socket.SOCK_DGRAM)
    with bind([*six, *four], socket.SOCK_DGRAM) as bound:
        assert bound.getsockname()[0] == "127.0.0.1"


async def test_port_is_free_after_close() -> None:
    async with running_server() as (_, port):
        client = await VrpnClient.connect(port)
        await wait_until_async(lambda: client.trackers)
    await wait_until_async(lambda: client.has_ended)
    await client.close()
    async with running_server(port), await VrpnClient.connect(port) as client:
        await wait_until_async(lambda: client.trackers)


async def test_udp_description_of_the_client_is_ignored(running: Running) -> None:
    """The client offers to receive poses by UDP. The server keeps to TCP, where none gets lost."""
    server, port = running
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        udp.setblocking(False)
        async with await VrpnClient.connect(port) as client:
            client.writer.write(message(udp.getsockname()[1], -3, b"127.0.0.1\0"))
            client.describe("wand")
            client.ping(0)
            await wait_until_async(lambda: client.pongs)
            server.send(encode_pose(0, 0, POSE))
            await wait_until_async(lambda: client.poses)
        with pytest.raises(BlockingIOError):
            udp.recv(100)
