"""The gateway process and its signals; tests/systemd runs it under a real systemd."""

import os
import pty
import signal
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.configurations import write_config
from tests.gateway_process import program
from tests.networks import free_endpoint, free_port, zenoh_keys
from tests.waiting import wait_until

STOP_S = 9
"""Much more than the gateway needs."""


class Notifications:
    """Records the notifications of a process on a socket like systemd's."""

    def __init__(self, socket_path: Path) -> None:
        self.path = socket_path
        self.texts: list[str] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(socket_path))
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        while text := self._socket.recv(4096).decode():
            self.texts.append(text)

    @property
    def status(self) -> str:
        return next((text for text in reversed(self.texts) if text.startswith("STATUS=")), "")

    @property
    def stages(self) -> list[str]:
        return [text for text in self.texts if not text.startswith(("STATUS=", "WATCHDOG="))]


class Site:
    """A configuration file and the gateway that runs with it."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "gateway.yaml"
        self.notifications = Notifications(folder / "notify")

    def configure(self, port: int) -> None:
        write_config(self.file, port, zenoh={"config": zenoh_keys("peer", listen=free_endpoint())})

    @contextmanager
    def running(self, **options: Any) -> Iterator[subprocess.Popen[bytes]]:
        environment = {"NOTIFY_SOCKET": str(self.notifications.path), "WATCHDOG_USEC": "200000"}
        options = {"stdin": subprocess.DEVNULL} | options
        with program("run", "--config", str(self.file), environ=environment, **options) as process:
            wait_until(lambda: "READY=1" in self.notifications.texts)
            yield process

    def until(self, condition: Callable[[Notifications], bool]) -> None:
        wait_until(lambda: condition(self.notifications))


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


def test_start_and_stop_are_reported_to_systemd(site: Site) -> None:
    port = free_port()
    site.configure(port)
    with site.running() as process:
        site.until(lambda sent: f"lab: waiting for 127.0.0.1:{port}" in sent.status)
        site.until(lambda sent: sent.texts.count("WATCHDOG=1") > 3)
        process.terminate()
        assert process.wait(STOP_S) == 0
    site.until(lambda sent: sent.stages == ["READY=1", "STOPPING=1"])
    before = site.notifications.texts[: site.notifications.texts.index("READY=1")]
    assert before[0] == "WATCHDOG=1"  # the watchdog and the status line are set before READY
    assert [text.partition(": ")[0] for text in before[1:]] == ["STATUS=lab"]
    assert "zenoh" not in before[1]  # the session is open by now, so it has no problem


def test_sighup_reloads_while_the_terminal_exists_and_stops_the_gateway_when_it_closes(site: Site) -> None:
    site.configure(free_port())
    terminal, end = pty.openpty()
    with site.running(stdin=end, stdout=end, stderr=end, start_new_session=True) as process:
        process.send_signal(signal.SIGHUP)
        site.until(lambda sent: sent.stages == ["READY=1", "RELOADING=1", "READY=1"])
        os.close(end)
        os.close(terminal)
        process.send_signal(signal.SIGHUP)  # the kernel sends it to the processes that the terminal controls
        assert process.wait(STOP_S) == 0
