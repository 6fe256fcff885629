"""Failures while a connection is opened."""

import asyncio
import socket
import subprocess
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import yaml

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.stream.files import IgnoredFiles
from gateway.stream.session import Session
from gateway.stream.status import StreamStatus
from gateway.stream.tcp import open_connection
from tests.gateway_process import PROGRAM
from tests.name_server import dead_name_server
from tests.networks import zenoh_keys
from tests.servers import ScriptedServer
from tests.waiting import wait_until


@pytest.mark.parametrize("is_cancelled", [False, True])
async def test_a_session_has_no_delay_and_can_be_closed_if_cancelled_while_it_connects(
    is_cancelled: bool,
) -> None:
    async def connect(source: SourceSettings, session: Any) -> asyncio.Transport:
        transport = await open_connection(source, session)
        tcp = transport.get_extra_info("socket")
        assert tcp.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        assert tcp.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        if is_cancelled:  # after the connection is made, before ``connect`` returns
            connecting.cancel()
            await asyncio.sleep(0)
        return transport

    async with ScriptedServer(lambda client: client.commands(lambda _: None)) as server:
        source, status = SourceSettings(name="lab", host="127.0.0.1", port=server.port), StreamStatus("3d")
        files = IgnoredFiles()
        session = Session(source, StreamSettings(), status, lambda *_: None, files, connect=connect)
        connecting = asyncio.create_task(session.connect())
        [error] = await asyncio.gather(connecting, return_exceptions=True)
        assert isinstance(error, asyncio.CancelledError) == is_cancelled
        assert session.is_open != is_cancelled
        await session.close()


@pytest.mark.netns
def test_late_answers_of_a_name_server_log_no_further_errors(tmp_path: Path) -> None:
    log, ended, answered = tmp_path / "gateway.log", threading.Event(), list[bytes]()
    error = "host name 'mocap-pc.example.' was not resolved within 0.1 s"

    def answer_late(server: socket.socket) -> None:
        """Answer each DNS query with SERVFAIL when the gateway has given up waiting for it."""
        with suppress(OSError):  # closed at the end of the test
            while True:
                query, client = server.recvfrom(4096)
                before = log.read_text().count(error)
                while log.read_text().count(error) == before and not ended.wait(0.01):
                    pass
                server.sendto(query[:2] + b"\x81\x82" + query[4:], client)
                answered.append(query)

    reconnect = {"first_delay_s": 0.01, "max_delay_s": 0.01}
    source = {"name": "lab", "host": "mocap-pc.example.", "connect_timeout_s": 0.1, "reconnect": reconnect}
    configuration = {
        "sources": [source],
        "zenoh": {"config": zenoh_keys("peer")},
        "lcm": {"enabled": False},
        "metrics": {"enabled": False},
    }
    file = tmp_path / "gateway.json"
    file.write_text(yaml.safe_dump(configuration))
    with (
        log.open("wb") as stderr,
        dead_name_server(tmp_path, serve=answer_late) as with_name_server,
        subprocess.Popen(
            [*with_name_server, *PROGRAM, "run", "--config", str(file), "--log-level", "debug"], stderr=stderr
        ) as process,
    ):
        try:
            wait_until(lambda: len(answered) > 6)  # several look-ups, each for A and AAAA
            process.terminate()
            process.wait(60)
        finally:
            ended.set()
            process.kill()
    assert " ERROR " not in log.read_text()
