"""The notifications, received on a socket like the one that systemd opens for services."""

import logging
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.service.systemd import SystemdNotifier


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """Return the socket on which systemd would receive the notifications."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(tmp_path / "notify"))
        receiver.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield receiver


@pytest.fixture(autouse=True)
def _no_watchdog(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("WATCHDOG_USEC", "WATCHDOG_PID"):
        monkeypatch.delenv(name, raising=False)


def received(manager: socket.socket) -> list[str]:
    texts = []
    while True:
        try:
            texts.append(manager.recv(4096).decode())
        except BlockingIOError:
            return texts


def test_every_stage_is_reported_and_alive_sends_the_status_on_one_line(manager: socket.socket) -> None:
    notifier = SystemdNotifier()
    notifier.notify_ready()
    notifier.notify_reloading()
    notifier.notify_alive("lab: streaming 200.0 Hz;\nREADY=1 → µ")
    notifier.notify_stopping()
    alive = ["WATCHDOG=1", "STATUS=lab: streaming 200.0 Hz; READY=1 → µ"]
    assert received(manager) == ["READY=1", "RELOADING=1", *alive, "STOPPING=1"]


def test_without_systemd_nothing_is_sent_or_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    notifier = SystemdNotifier()
    notifier.notify_ready()
    notifier.notify_alive("lab: streaming 200.0 Hz")
    assert not caplog.records


def test_an_unreachable_systemd_is_logged_as_a_warning_once(
    manager: socket.socket, caplog: pytest.LogCaptureFixture
) -> None:
    notifier = SystemdNotifier()
    manager.close()
    Path(os.environ["NOTIFY_SOCKET"]).unlink()
    notifier.notify_ready()
    notifier.notify_alive("lab: streaming 200.0 Hz")
    assert [each.levelname for each in caplog.records if each.levelno > logging.DEBUG] == ["WARNING"]


def test_without_cysystemd_one_warning_names_the_remedy(
    manager: socket.socket, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "cysystemd.daemon", None)
    notifier = SystemdNotifier()
    notifier.notify_ready()
    notifier.notify_alive("lab: streaming 200.0 Hz")
    [record] = caplog.records
    assert "pip install 'rtc3d-gateway[systemd]'" in record.message
    assert received(manager) == []


@pytest.mark.parametrize(
    ("environment", "period_s"),
    [
        ({}, 1.0),
        ({"WATCHDOG_USEC": "10000000"}, 1.0),
        ({"WATCHDOG_USEC": "500000"}, 0.25),
        ({"WATCHDOG_USEC": "500000", "WATCHDOG_PID": str(os.getpid())}, 0.25),
        ({"WATCHDOG_USEC": "500000", "WATCHDOG_PID": "1"}, 1.0),  # meant for another process
    ],
)
def test_the_period_is_at_most_half_the_watchdogs_timeout(
    environment: dict[str, str], period_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert SystemdNotifier().period_s == period_s
