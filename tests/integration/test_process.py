"""The gateway as a process: signals, the limits of the system, and a name server that answers late.

tests/systemd runs it under a real systemd.
"""

import itertools
import json
import os
import pty
import resource
import signal
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from http.client import HTTPConnection
from pathlib import Path
from typing import Any, Final

import pytest

from tests.support.configurations import write_config
from tests.support.gateway_process import PROGRAM, program
from tests.support.networks import dead_name_server, free_endpoint, free_port, zenoh_keys
from tests.support.waiting import wait_until

STOP_S: Final = 9
"""Much more than the gateway needs."""


# systemd and the terminal --------------------------------------------------------------------


class Site:
    """A gateway with the source lab at ``port``, and what it sends to a socket like systemd's."""

    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        zenoh = {"config": zenoh_keys("peer", listen=free_endpoint())}
        self.file = write_config(folder / "gateway.yaml", self.port, zenoh=zenoh)
        self.texts: list[str] = []
        self._address = str(folder / "notify")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self._address)
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        while text := self._socket.recv(4096).decode():
            self.texts.append(text)

    @property
    def stages(self) -> list[str]:
        return [text for text in self.texts if not text.startswith(("STATUS=", "WATCHDOG="))]

    @contextmanager
    def running(self, **options: Any) -> Iterator[subprocess.Popen[bytes]]:
        environment = {"NOTIFY_SOCKET": self._address, "WATCHDOG_USEC": "200000"}
        options = {"stdin": subprocess.DEVNULL} | options
        with program("run", "--config", str(self.file), environ=environment, **options) as process:
            wait_until(lambda: "READY=1" in self.texts)
            yield process


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


def test_start_and_stop_are_reported_to_systemd(site: Site) -> None:
    with site.running() as process:
        wait_until(lambda: any(f"lab: waiting for 127.0.0.1:{site.port}" in text for text in site.texts))
        wait_until(lambda: site.texts.count("WATCHDOG=1") > 3)
        process.terminate()
        assert process.wait(STOP_S) == 0
    wait_until(lambda: site.stages == ["READY=1", "STOPPING=1"])
    before = site.texts[: site.texts.index("READY=1")]
    assert before[0] == "WATCHDOG=1"  # the watchdog and the status line are set before READY
    assert [text.partition(": ")[0] for text in before[1:]] == ["STATUS=lab"]
    assert "zenoh" not in before[1]  # the session is open by now, so it has no problem


def test_sighup_reloads_while_the_terminal_exists_and_stops_the_gateway_when_it_closes(site: Site) -> None:
    terminal, end = pty.openpty()
    with site.running(stdin=end, stdout=end, stderr=end, start_new_session=True) as process:
        process.send_signal(signal.SIGHUP)
        wait_until(lambda: site.stages == ["READY=1", "RELOADING=1", "READY=1"])
        os.close(end)
        os.close(terminal)
        process.send_signal(signal.SIGHUP)  # the kernel sends it to the processes that the terminal controls
        assert process.wait(STOP_S) == 0


# Memory --------------------------------------------------------------------------------------

ARENA_BYTES: Final = 64 << 20
"""The address space that glibc reserves for the arena of a thread, and its alignment."""


def num_thread_arenas(pid: int) -> int:
    """Count the arenas beside the main one: pairs of used and reserved memory of that size."""
    lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
    ranges = [[int(end, 16) for end in line.split()[0].split("-")] for line in lines]
    return sum(
        used[0] % ARENA_BYTES == 0 and used[1] == reserved[0] and reserved[1] - used[0] == ARENA_BYTES
        for used, reserved in itertools.pairwise(ranges)
    )


def test_all_threads_share_one_arena_beside_the_main_one(site: Site) -> None:
    with site.running() as process:
        assert num_thread_arenas(process.pid) == 1


# File descriptors ----------------------------------------------------------------------------

NUM_FILES: Final = 60
_TEXT: Final = (
    f"all {NUM_FILES} file descriptors of the gateway are in use, so nobody can connect, and no file"
)


def reasons(port: int) -> list[str]:
    """Return the reasons on /healthz, each on a connection of its own."""
    connection = HTTPConnection("127.0.0.1", port, timeout=20)
    try:
        connection.request("GET", "/healthz")
        return list(json.loads(connection.getresponse().read())["reasons"])
    except ConnectionRefusedError:
        return ["it does not listen yet"]
    finally:
        connection.close()


def lacks_files(port: int) -> bool:
    return any(reason.startswith(f"gateway: {_TEXT}") for reason in reasons(port))


def _limit_files() -> None:
    resource.setrlimit(resource.RLIMIT_NOFILE, (NUM_FILES // 2, NUM_FILES))


@pytest.mark.netns
def test_without_file_descriptors_the_gateway_says_so_and_recovers(tmp_path: Path) -> None:
    """/healthz is wanted most then. The soft limit, which programs start with, is raised to the hard one."""
    port, metrics_port, log = free_port(), free_port(), tmp_path / "log"
    rtc3d = {"enabled": True, "ports": {"lab": port}}
    file = write_config(tmp_path / "gateway.yaml", free_port(), rtc3d=rtc3d, metrics={"port": metrics_port})
    with (
        log.open("wb") as stderr,
        program("run", "--config", str(file), stderr=stderr, preexec_fn=_limit_files),
        ExitStack() as clients,
    ):
        wait_until(lambda: "clients can connect to" in log.read_text() and not lacks_files(metrics_port))
        for each in [port] * NUM_FILES + [metrics_port] * 10:
            clients.enter_context(socket.create_connection(("127.0.0.1", each)))
        wait_until(lambda: lacks_files(metrics_port))
        assert all(lacks_files(metrics_port) for _ in range(10))
        assert log.read_text().count(_TEXT) == 1
        clients.close()
        wait_until(lambda: not lacks_files(metrics_port))
        with socket.create_connection(("127.0.0.1", port)) as client:
            client.sendall(bytes([0, 0, 0, 11, 0, 0, 0, 1]) + b"Bye")
            assert client.recv(100).endswith(b"bye")


# Names ---------------------------------------------------------------------------------------


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
