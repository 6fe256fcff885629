"""The process for LSL: started, replaced when it ends or hangs, and what is said about it."""

import errno
import importlib.util
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from gateway.errors import ConfigError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.outputs.adapters.lsl import supervisor
from gateway.outputs.adapters.lsl.output import LslOutput
from gateway.outputs.adapters.lsl.process import Kind, LslReport, Message, MessageReader
from gateway.outputs.adapters.lsl.settings import LslSettings
from gateway.outputs.adapters.lsl.supervisor import LslProcesses
from gateway.outputs.contract import ServerParameters
from gateway.rtc3d.parameters import Parameters, ParametersEvents
from tests.support.errors import names, raises
from tests.support.lsl_receiver import lsl_config
from tests.support.waiting import wait_until

TIMEOUT_S = 120.0
CANNOT_OPEN = Message(Kind.OPEN, 1, b'[{"name": "lab_3d"}, []]')

_GATEWAY = """
import signal, sys
from gateway.outputs.adapters.lsl.settings import LslSettings
from gateway.outputs.adapters.lsl.supervisor import LslProcesses
from tests.support.waiting import wait_until

processes = LslProcesses(LslSettings(enabled=True, config=sys.argv[1]))
processes.restart()
wait_until(lambda: processes.version)
print(processes._process.pid, flush=True)
signal.pause()
"""


# With a process -----------------------------------------------------------------------------


@pytest.fixture
def processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[LslProcesses]:
    monkeypatch.setattr(supervisor, "_FIRST_RETRY_S", 0.05)
    processes = LslProcesses(LslSettings(enabled=True, config=str(lsl_config(tmp_path))))
    processes._retry_delay_s = 0.05
    yield processes
    processes.stop()


def start(processes: LslProcesses) -> int:
    """Start a process, which has no streams, and wait until it is ready; return its number."""
    wait_until(lambda: processes.is_due, TIMEOUT_S)
    assert processes.restart()
    wait_until(lambda: not processes.problem, TIMEOUT_S)
    assert processes._process is not None
    return processes._process.pid


def problem(processes: LslProcesses) -> str:
    """Return the next problem."""
    wait_until(lambda: processes.problem, TIMEOUT_S)
    return processes.problem


def test_the_threads_of_liblsl_do_not_interrupt_the_one_that_pushes(processes: LslProcesses) -> None:
    """Otherwise each sample wakes a thread, which costs most of the time at 1000 Hz."""
    threads = Path(f"/proc/{start(processes)}/task").iterdir()
    assert {os.sched_getscheduler(int(each.name)) for each in threads} == {os.SCHED_BATCH}


def test_a_process_loads_liblsl_and_ends_with_its_supervisor(processes: LslProcesses) -> None:
    assert "not started" in processes.problem
    number = start(processes)
    assert int(processes.version) >= 116
    assert not processes.is_due
    processes.stop()
    assert not Path(f"/proc/{number}").exists()
    assert not processes.is_due
    assert names(processes.problem, "closed")
    assert not processes.send(Message(Kind.CLOSE, 1))


def test_the_process_lives_on_while_nothing_is_sent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel kills it when the thread that started it ends, as other idle threads do."""
    monkeypatch.setattr("gateway.runtime.workers._IDLE_S", 0.0)
    output = LslOutput(LslSettings(enabled=True, config=str(lsl_config(tmp_path))))
    output.start()
    try:
        wait_until(lambda: output.version)
        assert "lsl-send" in {thread.name for thread in threading.enumerate()}
    finally:
        output.close()


def test_a_process_that_ended_is_replaced(processes: LslProcesses, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    first = start(processes)
    os.kill(first, signal.SIGKILL)
    assert names(problem(processes), "SIGKILL")
    assert start(processes) != first
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert [names(warning, "lsl", "SIGKILL") for warning in warnings] == [True]
    assert names(caplog.records[-1].getMessage(), "liblsl", processes.version)


def test_a_stream_that_cannot_open_is_reported_and_signals_are_ignored(
    processes: LslProcesses,
) -> None:
    """Those that stop a gateway."""
    number = start(processes)
    os.kill(number, signal.SIGTERM)
    os.kill(number, signal.SIGINT)
    processes.send(CANNOT_OPEN)
    assert names(problem(processes), "lab_3d")
    processes.send(Message(Kind.CLOSE, 1))
    wait_until(lambda: not processes.problem, TIMEOUT_S)


@pytest.mark.parametrize("sends", [False, True], ids=["nothing sent", "a lot sent"])
def test_a_process_that_hangs_is_killed_and_replaced(
    processes: LslProcesses, monkeypatch: pytest.MonkeyPatch, sends: bool
) -> None:
    monkeypatch.setattr(supervisor, "SILENCE_S", 6.0)
    first = start(processes)
    os.kill(first, signal.SIGSTOP)
    large = Message(Kind.TEXTS, 1, bytes(1_000_000))
    sent = 0
    while sends and processes.send(large):
        sent += 1
        assert sent < 100
    text = problem(processes)
    assert names(text, "6 s") or names(text, "SIGKILL")
    assert start(processes) != first


def test_a_process_that_hangs_ends_with_a_gateway_that_is_killed(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _GATEWAY, str(lsl_config(tmp_path))]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as gateway:
        assert gateway.stdout is not None
        number = int(gateway.stdout.readline())
        os.kill(number, signal.SIGSTOP)
        gateway.kill()
    wait_until(lambda: not Path(f"/proc/{number}/exe").exists(), TIMEOUT_S)


def test_why_liblsl_cannot_be_loaded_is_said(
    processes: LslProcesses, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Modules in the working directory are not used, but those on the path are."""
    (tmp_path / "pylsl.py").write_text("raise ImportError('libc is too old')")
    (tmp_path / "queue.py").write_text("raise ImportError('a program of the user')")
    with monkeypatch.context() as elsewhere:
        elsewhere.chdir(tmp_path)
        os.kill(start(processes), signal.SIGKILL)
        problem(processes)
    (tmp_path / "queue.py").unlink()
    monkeypatch.syspath_prepend(tmp_path)
    wait_until(lambda: processes.is_due, TIMEOUT_S)
    processes.restart()
    wait_until(lambda: "failed" in processes.problem, TIMEOUT_S)
    text = "the process for LSL failed: ImportError: libc is too old; it is started again"
    assert processes.problem == text


def test_a_failed_start_is_tried_again(processes: LslProcesses, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as without_descriptors:
        error = OSError(errno.EMFILE, os.strerror(errno.EMFILE))
        without_descriptors.setattr(socket, "socketpair", Mock(side_effect=error))
        assert not processes.restart()
    text = "the process for LSL cannot be started: Too many open files; it is started again"
    assert processes.problem == text
    start(processes)


def test_what_is_missing_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    with raises(ConfigError, "lsl.config", "/no/such/file"):
        LslOutput(LslSettings(enabled=True, config="/no/such/file"))
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *more: None if name == "pylsl" else find(name, *more)
    )
    with raises(ConfigError, "'pylsl'", "'rtc3d-gateway[lsl]'"):
        LslOutput(LslSettings(enabled=True))


# Without a process: sockets in its place, and a clock to set -----------------------------------


class Lab:
    """Processes whose time is ``now_s``. A process ends when the test closes its end of the socket."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        self.theirs: socket.socket
        self.changes: list[frozenset[int]] = []
        monkeypatch.setattr(supervisor, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        monkeypatch.setattr(supervisor, "_start_process", self._start)
        self.processes = LslProcesses(LslSettings(enabled=True), self._note)

    def _start(self, _settings: LslSettings) -> tuple[socket.socket, Mock]:
        ours, self.theirs = socket.socketpair()
        return ours, Mock(wait=Mock(return_value=3))

    def _note(self) -> None:
        self.changes.append(self.processes.wanted)

    def live(self, seconds: float) -> None:
        """Start a process that ends after this time."""
        assert self.processes.is_due
        self.processes.restart()
        self.now_s += seconds
        self.theirs.close()
        wait_until(lambda: self.processes._socket is None and "status 3" in self.processes.problem)

    def delay_s(self) -> float:
        """Return how long it takes until the next process is due, to a tenth of a second."""
        began_s = self.now_s
        while not self.processes.is_due:
            self.now_s += 0.1
        return round(self.now_s - began_s, 1)


def test_the_next_process_gets_the_streams_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that receive them continue."""
    connections: list[socket.socket] = []

    def start(_settings: LslSettings) -> tuple[socket.socket, Mock]:
        ours, theirs = socket.socketpair()
        connections.append(theirs)
        return ours, Mock(wait=Mock(return_value=3))

    def received() -> list[Message]:
        connections[-1].settimeout(TIMEOUT_S)
        return list(MessageReader().feed(connections[-1].recv(65536)))

    def has_next() -> bool:
        output.maintain()
        return len(connections) == 2

    monkeypatch.setattr(supervisor, "_FIRST_RETRY_S", 0.01)
    monkeypatch.setattr(supervisor, "_start_process", start)
    output = LslOutput(LslSettings(enabled=True))
    output.frame_publisher("lab")
    output.start()
    wait_until(lambda: connections)
    parsed = Parameters(events=ParametersEvents())
    output.publish_parameters("lab", ServerParameters(b"", 1, 1, parsed=parsed, frame=CoordinateFrame("lab")))
    [first] = received()
    assert (first.kind, first.stream) == (Kind.OPEN, 1)
    connections[0].close()
    wait_until(has_next)
    assert received() == [first]
    output.close()
    connections[1].close()


def test_why_a_process_ended_is_known_as_soon_as_it_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody ever sees the problem of the time before the first process again."""
    lab = Lab(monkeypatch)
    seen: list[str] = []

    def start(_settings: LslSettings) -> tuple[Mock, Mock]:
        ours, lab.theirs = socket.socketpair()

        def close() -> None:
            seen.append(lab.processes.problem)
            ours.close()

        return Mock(wraps=ours, close=close), Mock(wait=Mock(return_value=3))

    monkeypatch.setattr(supervisor, "_start_process", start)
    before = lab.processes.problem
    lab.live(0.0)
    wait_until(lambda: seen)
    assert seen == [lab.processes.problem] != [before]


def test_the_wait_for_the_next_process_doubles_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that cannot live must not cost all the time; one that lived is replaced soon."""
    lab = Lab(monkeypatch)
    delays_s = []
    for lived_s in (0, 0, 0, 0, 59, 0, 0, 60, 0):
        lab.live(lived_s)
        delays_s.append(lab.delay_s())
    assert delays_s == pytest.approx([1, 2, 4, 8, 16, 30, 30, 1, 2], abs=0.11)


def test_each_change_of_what_is_received_is_reported_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was received stays wanted until the next process knows it; nothing is after the end."""
    lab = Lab(monkeypatch)
    lab.processes.restart()
    assert not lab.processes.is_due  # there is one
    for wanted, failed in (((1,), ""), ((1,), "x"), ((1, 2), "x"), ((), "x"), ((3,), "")):
        report = LslReport(ready="116", wanted=wanted, not_opened=failed)
        lab.theirs.sendall(report.encode())
        wait_until(lambda report=report: lab.processes._report == report)  # type: ignore[misc]
    assert lab.changes == [{1}, {1, 2}, set(), {3}]
    lab.theirs.close()
    wait_until(lambda: lab.processes._socket is None)
    assert lab.processes.wanted == {3}
    lab.now_s += 60
    lab.processes.stop()
    assert lab.changes[-1] == set()
    assert not lab.processes.is_due
