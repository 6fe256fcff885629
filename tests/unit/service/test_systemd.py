"""What systemd hears, on a socket as it gives to services."""

import logging
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.service.systemd import Systemd


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """Systemd's end of the notifications."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield manager


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


def test_each_stage_is_told(told: socket.socket) -> None:
    systemd = Systemd()
    systemd.ready()
    systemd.reloading()
    systemd.stopping()
    assert received(told) == ["READY=1", "RELOADING=1", "STOPPING=1"]


def test_a_sign_of_life_feeds_the_watchdog_and_has_the_status_on_one_line(told: socket.socket) -> None:
    Systemd().alive("lab: streaming 200.0 Hz;\nREADY=1 → µ")
    assert received(told) == ["WATCHDOG=1", "STATUS=lab: streaming 200.0 Hz; READY=1 → µ"]


def test_without_systemd_nothing_happens(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    systemd = Systemd()
    systemd.ready()
    systemd.alive("lab: streaming 200.0 Hz")
    assert not caplog.records


def test_a_systemd_that_does_not_hear_is_told_of_once(
    told: socket.socket, caplog: pytest.LogCaptureFixture
) -> None:
    systemd = Systemd()
    told.close()
    Path(os.environ["NOTIFY_SOCKET"]).unlink()
    systemd.ready()
    systemd.alive("lab: streaming 200.0 Hz")
    assert [record.levelno for record in caplog.records if record.levelno > logging.DEBUG] == [
        logging.WARNING
    ]


def test_without_cysystemd_the_remedy_is_told_once(
    told: socket.socket, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "cysystemd.daemon", None)
    systemd = Systemd()
    systemd.ready()
    systemd.alive("lab: streaming 200.0 Hz")
    [record] = caplog.records
    assert "pip install 'rtc3d-gateway[systemd]'" in record.message
    assert received(told) == []


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
def test_a_sign_of_life_is_given_twice_within_the_watchdogs_time(
    environment: dict[str, str], period_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert Systemd().period_s == period_s
