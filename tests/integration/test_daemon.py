"""The gateway's process, and its signals; what a real systemd makes of it is in tests/systemd."""

import asyncio
import json
import os
import pty
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

from gateway.rtc3d_server.server import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.networks import free_endpoint, free_port, zenoh_keys
from tests.waiting import wait_until, wait_until_async

GATEWAY = (sys.executable, "-m", "gateway", "run", "--config")
SUBSCRIBER = """
import sys, zenoh
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
session.declare_subscriber("mocap/lab/3d", lambda sample: print("heard", flush=True))
sys.stdin.read()
"""
STOP_S = 5
"""Twice what the gateway takes and more; closing Zenoh with a peer that does not read would take 10 s."""


class Notifications:
    """What a process tells systemd, of which this is the socket."""

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
    """A configuration file, and the gateway that runs with it."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "gateway.yaml"
        self.endpoint = free_endpoint()
        self.systemd = Notifications(folder / "notify")

    def configure(self, port: int, **sections: Any) -> None:
        configuration = {
            "sources": [{"name": "lab", "host": "127.0.0.1", "port": port}],
            "zenoh": {"config": zenoh_keys("peer", listen=self.endpoint)},
            "lcm": {"enabled": False},
            "metrics": {"enabled": False},
        }
        self.file.write_text(yaml.safe_dump(configuration | sections))

    @contextmanager
    def running(self, **options: Any) -> Iterator[subprocess.Popen[str]]:
        environment = {**os.environ, "NOTIFY_SOCKET": str(self.systemd.path), "WATCHDOG_USEC": "200000"}
        command = [*GATEWAY, str(self.file)]
        options = {"stdin": subprocess.DEVNULL} | options
        with subprocess.Popen(command, env=environment, text=True, **options) as process:
            try:
                wait_until(lambda: "READY=1" in self.systemd.texts)
                yield process
            finally:
                process.kill()

    def until(self, condition: Callable[[Notifications], bool]) -> None:
        wait_until(lambda: condition(self.systemd))


@contextmanager
def subscriber(endpoint: str) -> Iterator[subprocess.Popen[str]]:
    """Run a process that subscribes, and prints a line for each message."""
    command = [sys.executable, "-c", SUBSCRIBER, json.dumps(zenoh_keys("client", connect=endpoint))]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


def test_start_and_stop_are_told(site: Site) -> None:
    port = free_port()
    site.configure(port)
    with site.running() as process:
        site.until(lambda told: f"lab: waiting for 127.0.0.1:{port}" in told.status)
        site.until(lambda told: told.texts.count("WATCHDOG=1") > 3)
        process.terminate()
        assert process.wait(STOP_S) == 0
    assert site.systemd.stages == ["READY=1", "STOPPING=1"]
    before = site.systemd.texts[: site.systemd.texts.index("READY=1")]
    assert before[0] == "WATCHDOG=1"  # who is ready is alive, and has a status to show
    assert [text.partition(": ")[0] for text in before[1:]] == ["STATUS=lab"]
    assert "zenoh" not in before[1]  # else it would say that the session is not open yet


def test_a_hangup_loads_the_configuration_anew(site: Site) -> None:
    first, second = free_port(), free_port()
    site.configure(first)
    with site.running() as process:
        site.file.write_text("sources: {}\nbogus: 1\n")
        process.send_signal(signal.SIGHUP)
        site.until(lambda told: "new configuration refused, the old one runs on: " in told.status)
        site.until(lambda told: told.stages == ["READY=1", "RELOADING=1", "READY=1"])
        assert f"{site.file}:1:10: sources: " in site.systemd.status
        assert "(and 1 more in the log)" in site.systemd.status
        assert f"lab: waiting for 127.0.0.1:{first}" in site.systemd.status
        site.configure(second)
        process.send_signal(signal.SIGHUP)
        site.until(lambda told: f"lab: waiting for 127.0.0.1:{second}" in told.status)
        assert "refused" not in site.systemd.status
        process.terminate()
        assert process.wait(STOP_S) == 0


def test_the_end_of_its_terminal_is_the_end_of_the_gateway(site: Site) -> None:
    site.configure(free_port())
    terminal, end = pty.openpty()
    with site.running(stdin=end, stdout=end, stderr=end, start_new_session=True) as process:
        os.close(end)
        os.close(terminal)
        process.send_signal(signal.SIGHUP)  # as the kernel does for who has it as controlling terminal
        assert process.wait(STOP_S) == 0


def test_a_hangup_on_a_terminal_that_is_there_is_a_reload(site: Site) -> None:
    site.configure(free_port())
    terminal, end = pty.openpty()
    with site.running(stdin=end, start_new_session=True) as process:
        process.send_signal(signal.SIGHUP)
        site.until(lambda told: told.stages == ["READY=1", "RELOADING=1", "READY=1"])
        process.terminate()
        assert process.wait(STOP_S) == 0
    os.close(end)
    os.close(terminal)


def test_a_zenoh_that_does_not_open_does_not_hold_up_the_end(site: Site) -> None:
    away = zenoh_keys("client", connect=site.endpoint)
    away["connect"]["timeout_ms"] = -1  # opening never returns
    site.configure(free_port(), zenoh={"config": away})
    with site.running() as process:
        assert "zenoh: the Zenoh session is not open yet" in site.systemd.status
        process.terminate()
        assert process.wait(STOP_S) == 0


async def test_a_subscriber_that_does_not_read_does_not_hold_up_the_end(site: Site) -> None:
    scene = SyntheticScene(markers=3000, tools=0, analog=0, plates=0, rate_hz=200)  # 48 kB a frame
    async with Simulator(scene) as server:
        site.configure(server.port)
        with site.running() as process, subscriber(site.endpoint) as frozen:
            assert frozen.stdout is not None
            assert await asyncio.to_thread(frozen.stdout.readline) == "heard\n"
            frozen.send_signal(signal.SIGSTOP)
            full = server.frames_sent + 300  # more than any socket's buffers hold
            await wait_until_async(lambda: server.frames_sent > full)
            process.terminate()
            assert await asyncio.to_thread(process.wait, STOP_S) == 0
