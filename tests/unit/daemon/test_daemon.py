"""The notifications, received on a socket like the one that systemd opens for services.

The daemon in virtual time: signals, reloads and the notifications for systemd.
"""

import asyncio
import errno
import itertools
import logging
import os
import signal
import socket
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from gateway.config.settings import MetricsSettings, Settings, SourceSettings
from gateway.daemon.daemon import Daemon, SystemdNotifier
from gateway.daemon.gateway import Gateway
from gateway.errors import ConfigError
from tests.support.clocks import settle, until
from tests.support.errors import names
from tests.support.memory_output import MemoryOutput
from tests.unit.daemon.scripted_sources import Servers, SlowThreads


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
    notifier.notify("READY")
    notifier.notify("RELOADING")
    notifier.notify_alive("lab: streaming 200.0 Hz;\nREADY=1 → µ")
    notifier.notify("STOPPING")
    alive = ["WATCHDOG=1", "STATUS=lab: streaming 200.0 Hz; READY=1 → µ"]
    assert received(manager) == ["READY=1", "RELOADING=1", *alive, "STOPPING=1"]


def test_without_systemd_nothing_is_sent_or_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    notifier = SystemdNotifier()
    notifier.notify("READY")
    notifier.notify_alive("lab: streaming 200.0 Hz")
    assert not caplog.records


def test_an_unreachable_systemd_is_logged_as_a_warning_once(
    manager: socket.socket, caplog: pytest.LogCaptureFixture
) -> None:
    notifier = SystemdNotifier()
    manager.close()
    Path(os.environ["NOTIFY_SOCKET"]).unlink()
    notifier.notify("READY")
    notifier.notify_alive("lab: streaming 200.0 Hz")
    assert [each.levelname for each in caplog.records if each.levelno > logging.DEBUG] == ["WARNING"]


def test_without_cysystemd_one_warning_names_the_remedy(
    manager: socket.socket, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "cysystemd.daemon", None)
    notifier = SystemdNotifier()
    notifier.notify("READY")
    notifier.notify_alive("lab: streaming 200.0 Hz")
    [record] = caplog.records
    assert names(record.message, "'rtc3d-gateway[systemd]'")
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


pytestmark = pytest.mark.usefixtures("servers", "threads")


class Notifications:
    """Records what the daemon notifies systemd of."""

    period_s = 0.5

    def __init__(self) -> None:
        self.sent: list[str] = []
        self.notify = self.sent.append

    def notify_alive(self, status: str) -> None:
        self.sent.append(f"STATUS={status}")


@pytest.fixture
def systemd(monkeypatch: pytest.MonkeyPatch) -> Notifications:
    notifications = Notifications()
    monkeypatch.setattr("gateway.daemon.daemon.SystemdNotifier", lambda: notifications)
    return notifications


def settings(*names: str) -> Settings:
    sources = tuple(SourceSettings(name=name, host="server") for name in names)
    return Settings(sources=sources, metrics=MetricsSettings(enabled=False))


class Configuration:
    """The configuration file: ``load`` returns its settings, or raises its error."""

    def __init__(self) -> None:
        self.content: Settings | ConfigError = settings("lab")
        self.num_loaded = 0

    def load(self) -> Settings:
        self.num_loaded += 1
        if isinstance(self.content, ConfigError):
            raise self.content
        return self.content


@asynccontextmanager
async def running(configuration: Configuration) -> AsyncIterator[tuple[Gateway, asyncio.Task[None]]]:
    """Run a daemon, and stop it at SIGTERM or at the end of the block."""
    gateway = Gateway(settings("lab"), [MemoryOutput()])
    daemon = Daemon(configuration.load, gateway)
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGTERM, daemon.request_stop)  # as Signals does in a process
    loop.add_signal_handler(signal.SIGHUP, daemon.hang_up)
    task = asyncio.create_task(daemon.run())
    await gateway.opened.wait()
    await settle()
    yield gateway, task
    daemon.request_stop()
    await task
    for number in (signal.SIGTERM, signal.SIGHUP):
        loop.remove_signal_handler(number)


def source_names(gateway: Gateway) -> list[str]:
    return [source.settings.name for source in gateway.sources]


async def hang_up(systemd: Notifications) -> list[str]:
    """Send SIGHUP, and return the notifications until the reload has ended."""
    systemd.sent.clear()
    os.kill(os.getpid(), signal.SIGHUP)
    await until(lambda: "READY" in systemd.sent)
    return systemd.sent[systemd.sent.index("RELOADING") :]


async def test_the_start_is_reported_with_a_status_and_then_repeated(systemd: Notifications) -> None:
    async with running(Configuration()):
        assert systemd.sent[0].startswith("STATUS=lab: ")
        assert systemd.sent[1] == "READY"
        systemd.sent.clear()
        await asyncio.sleep(5.1 * systemd.period_s)
        assert len(systemd.sent) == 5
        assert all(text.startswith("STATUS=lab: ") for text in systemd.sent)


@pytest.mark.usefixtures("threads")
async def test_freed_memory_is_returned_each_minute_if_a_thread_can_be_started(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After floods and reloads, a gateway that runs for months must not stay as large as it once was."""
    returned: list[float] = []

    def return_memory() -> None:
        returned.append(asyncio.get_running_loop().time())
        if len(returned) == 1:
            raise OSError(errno.EAGAIN, "can't start new thread")

    monkeypatch.setattr("gateway.daemon.daemon.return_free_memory", return_memory)
    async with running(Configuration()):
        await asyncio.sleep(185)
    assert [round(later - earlier) for earlier, later in itertools.pairwise(returned)] == [60, 60]


async def test_a_request_stops_the_gateway_and_all_tasks(systemd: Notifications, servers: Servers) -> None:
    async with running(Configuration()) as (gateway, task):
        await until(lambda: gateway.sources[0].streams[0].session)
        await settle()
        os.kill(os.getpid(), signal.SIGTERM)
        await asyncio.wait([task], timeout=30)
        assert task.done()
        assert servers["server"].connection.commands[-1] == "Bye"
        assert systemd.sent[-1] == "STOPPING"
        assert asyncio.all_tasks() == {asyncio.current_task()}


async def test_sighup_applies_the_new_configuration(
    systemd: Notifications, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    configuration = Configuration()
    async with running(configuration) as (gateway, _):
        configuration.content = settings("lab", "hall")
        sent = await hang_up(systemd)
        assert (sent[0], sent[-1]) == ("RELOADING", "READY")
        assert source_names(gateway) == ["lab", "hall"]
        assert "configuration reloaded: source hall added" in caplog.messages
        await hang_up(systemd)
        assert "configuration reloaded: nothing changed" in caplog.messages


async def test_a_refused_configuration_shows_in_the_status_until_one_is_accepted(
    systemd: Notifications, caplog: pytest.LogCaptureFixture
) -> None:
    configuration = Configuration()
    async with running(configuration) as (gateway, _):
        mistakes = ["lab.yaml:3:1: one", "lab.yaml:4:1: two", "lab.yaml:5:1: three"]
        configuration.content = ConfigError("\n".join(mistakes))
        sent = await hang_up(systemd)
        problem = (
            f"new configuration refused, the old one stays in use: {mistakes[0]} (and 2 more in the log)"
        )
        assert sent[1].startswith(f"STATUS={problem}; lab: ")
        refused = "new configuration refused: "
        lines = [text.removeprefix(refused) for text in caplog.messages if text.startswith(refused)]
        assert (lines, source_names(gateway)) == (mistakes, ["lab"])
        configuration.content = settings("hall")
        assert (await hang_up(systemd))[1].startswith("STATUS=hall: ")


async def test_signals_during_a_reload_cause_one_more_reload(
    systemd: Notifications, threads: SlowThreads
) -> None:
    configuration = Configuration()
    async with running(configuration):
        threads.is_slow = True
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGHUP)
            await settle()
        assert threads.num_waiting == 1
        threads.is_slow = False
        threads.finish()
        await until(lambda: systemd.sent.count("READY") == 3)  # the start, and two reloads
        await asyncio.sleep(5)
        assert configuration.num_loaded == 2


async def test_the_end_of_the_terminal_stops_a_gateway_that_it_started(
    systemd: Notifications, monkeypatch: pytest.MonkeyPatch
) -> None:
    has_terminal = True
    monkeypatch.setattr("os.isatty", lambda _: has_terminal)
    configuration = Configuration()
    async with running(configuration) as (_, task):
        os.kill(os.getpid(), signal.SIGHUP)
        await until(lambda: configuration.num_loaded == 1)
        has_terminal = False
        os.kill(os.getpid(), signal.SIGHUP)
        await asyncio.wait([task], timeout=30)
        assert task.done()
        assert systemd.sent[-1] == "STOPPING"
