"""Failures while a connection is opened."""

import socket
import subprocess
import threading
from contextlib import suppress
from pathlib import Path

import pytest

from tests.configurations import write_config
from tests.gateway_process import PROGRAM
from tests.name_server import dead_name_server
from tests.networks import zenoh_keys
from tests.waiting import wait_until


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
    source = {"host": "mocap-pc.example.", "connect_timeout_s": 0.1, "reconnect": reconnect}
    zenoh = {"config": zenoh_keys("peer")}
    file = write_config(tmp_path / "gateway.yaml", 3020, source=source, zenoh=zenoh)
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
