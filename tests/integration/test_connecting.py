"""Failures while a connection is opened."""

import asyncio
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.stream.files import IgnoredFiles
from gateway.stream.session import Session
from gateway.stream.status import StreamStatus
from gateway.stream.tcp import Connect, open_connection
from tests.networks import zenoh_keys
from tests.servers import Client, ScriptedServer
from tests.waiting import wait_until

WITH_NAMESERVER = """
mount --bind "$1" /etc/resolv.conf
[ ! -e /etc/nsswitch.conf ] || mount --bind "$2" /etc/nsswitch.conf
shift 2
exec "$@"
"""
"""Runs a command with another resolv.conf and nsswitch.conf."""


def session_to(port: int, connect: Connect = open_connection) -> Session:
    source = SourceSettings(name="lab", host="127.0.0.1", port=port)
    return Session(
        source, StreamSettings(), StreamStatus("3d"), lambda *_: None, IgnoredFiles(), connect=connect
    )


class CallingProtocol(asyncio.Protocol):
    """Wraps a session, and calls ``on_made`` when the connection is made, before ``connect`` returns."""

    def __init__(self, session: Any, on_made: Callable[[], object]) -> None:
        self._session = session
        self._on_made = on_made

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._session.connection_made(transport)
        self._on_made()

    def connection_lost(self, exc: Exception | None) -> None:
        self._session.connection_lost(exc)


async def silent(client: Client) -> None:
    await client.commands(lambda _: None)


async def test_the_connection_has_no_delay_and_keep_alive() -> None:
    async with ScriptedServer(silent) as server:
        session = session_to(server.port)
        await session.connect()
        assert session._transport is not None
        tcp = session._transport.get_extra_info("socket")
        assert tcp.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        assert tcp.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        await session.close()


async def test_a_connect_cancelled_at_the_moment_of_connecting_leaves_a_session_that_can_be_closed() -> None:
    async def connect(source: SourceSettings, session: Any) -> asyncio.Transport:
        return await open_connection(source, CallingProtocol(session, connecting.cancel))

    async with ScriptedServer(silent) as server:
        session = session_to(server.port, connect)
        connecting = asyncio.create_task(session.connect())
        with pytest.raises(asyncio.CancelledError):
            await connecting
        assert not session.is_open
        await session.close()


class SlowNameServer:
    """Answers each DNS query only after two more have arrived, and then with SERVFAIL."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 53))
        self.queries: list[tuple[bytes, tuple[str, int]]] = []
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            query, client = self._socket.recvfrom(4096)
            self.queries.append((query, client))
            if len(self.queries) > 2:
                query, client = self.queries[-3]
                self._socket.sendto(query[:2] + b"\x81\x82" + query[4:], client)  # SERVFAIL


def with_own_nameserver(tmp_path: Path) -> list[str]:
    """Return the first words of a command that runs with the name server of this test."""
    resolver, switch = tmp_path / "resolv.conf", tmp_path / "nsswitch.conf"
    resolver.write_text("nameserver 127.0.0.1\noptions timeout:1 attempts:1\n")
    switch.write_text("hosts: files dns\n")
    return ["unshare", "--mount", "sh", "-ec", WITH_NAMESERVER, "sh", str(resolver), str(switch)]


@pytest.mark.netns
def test_late_answers_of_a_name_server_log_no_further_errors(tmp_path: Path) -> None:
    server = SlowNameServer()
    source = {
        "name": "lab",
        "host": "mocap-pc.example.",
        "connect_timeout_s": 0.1,
        "reconnect": {"first_delay_s": 0.01, "max_delay_s": 0.01},
    }
    configuration = {
        "sources": [source],
        "zenoh": {"config": zenoh_keys("peer")},
        "lcm": {"enabled": False},
        "metrics": {"enabled": False},
    }
    file = tmp_path / "gateway.json"
    file.write_text(yaml.safe_dump(configuration))
    command = [*with_own_nameserver(tmp_path), sys.executable, "-m", "gateway", "run", "--config", str(file)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            wait_until(lambda: len(server.queries) > 6)  # several look-ups, each for A and AAAA
            process.terminate()
            _, log = process.communicate(timeout=20)
        finally:
            process.kill()
    assert "host name 'mocap-pc.example.' was not resolved within 0.1 s" in log
    assert " ERROR " not in log
