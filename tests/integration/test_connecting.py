"""What can happen while a connection is being made."""

import asyncio
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest
import yaml

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.stream.session import Handlers, Session
from gateway.stream.status import StreamStatus
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


def session_to(port: int) -> Session:
    source = SourceSettings(name="lab", host="127.0.0.1", port=port)
    handlers = Handlers(lambda *_: None, lambda *_: None, lambda _: None)
    return Session(source, StreamSettings(), StreamStatus("3d"), handlers)


class HastyLoop:
    """A loop that calls back as soon as a connection is made, which is before anybody has it."""

    def __init__(self, made: Callable[[], object]) -> None:
        self._loop = asyncio.get_running_loop()
        self._made = made

    async def create_connection(self, factory: Callable[[], Any], host: str, port: int) -> Any:
        return await self._loop.create_connection(lambda: HastyProtocol(factory(), self._made), host, port)


class HastyProtocol(asyncio.Protocol):
    def __init__(self, session: Any, made: Callable[[], object]) -> None:
        self._session = session
        self._made = made

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._session.connection_made(transport)
        self._made()

    def connection_lost(self, exc: Exception | None) -> None:
        self._session.connection_lost(exc)


async def silent(client: Client) -> None:
    await client.commands(lambda _: None)


async def test_commands_leave_at_once_and_a_vanished_server_is_noticed() -> None:
    async with ScriptedServer(silent) as server:
        session = session_to(server.port)
        await session.connect()
        assert session._transport is not None
        tcp = session._transport.get_extra_info("socket")
        assert tcp.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        assert tcp.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        await session.close()


async def test_a_connection_given_up_in_the_moment_it_is_made_can_be_closed() -> None:
    async with ScriptedServer(silent) as server:
        session = session_to(server.port)
        connecting = asyncio.create_task(session.connect())
        session._loop = cast(asyncio.AbstractEventLoop, HastyLoop(connecting.cancel))
        with pytest.raises(asyncio.CancelledError):
            await connecting
        assert not session.is_open
        await session.close()


class SlowNameServer:
    """Answers each question only once two more have come, and then that it cannot tell."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 53))
        self.questions: list[tuple[bytes, tuple[str, int]]] = []
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            question, client = self._socket.recvfrom(4096)
            self.questions.append((question, client))
            if len(self.questions) > 2:
                question, client = self.questions[-3]
                self._socket.sendto(question[:2] + b"\x81\x82" + question[4:], client)  # SERVFAIL


def asking_this_machine(tmp_path: Path) -> list[str]:
    """Return what begins a command that has a name server of this machine."""
    resolver, switch = tmp_path / "resolv.conf", tmp_path / "nsswitch.conf"
    resolver.write_text("nameserver 127.0.0.1\noptions timeout:1 attempts:1\n")
    switch.write_text("hosts: files dns\n")
    return ["unshare", "--mount", "sh", "-ec", WITH_NAMESERVER, "sh", str(resolver), str(switch)]


@pytest.mark.netns
def test_a_name_server_that_answers_too_late_is_one_problem_and_not_two(tmp_path: Path) -> None:
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
    command = [*asking_this_machine(tmp_path), sys.executable, "-m", "gateway", "run", "--config", str(file)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            wait_until(lambda: len(server.questions) > 16)
            process.terminate()
            _, log = process.communicate(timeout=20)
        finally:
            process.kill()
    assert "no answer from mocap-pc.example.:3020 within 0.1 s" in log
    assert " ERROR " not in log
