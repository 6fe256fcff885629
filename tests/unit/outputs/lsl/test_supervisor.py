"""The process for LSL: started, replaced when it ends or hangs, and what is said about it."""

import errno
import importlib.util
import logging
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gateway.errors import ConfigError
from gateway.outputs.lsl import supervisor
from gateway.outputs.lsl.output import LslOutput
from gateway.outputs.lsl.settings import LslSettings
from gateway.outputs.lsl.supervisor import LslProcesses
from gateway.outputs.lsl.wire import Kind, Message
from tests.lsl_receiver import lsl_config
from tests.waiting import wait_until

TIMEOUT_S = 30.0

_GATEWAY = """
import signal, sys
from gateway.outputs.lsl.settings import LslSettings
from gateway.outputs.lsl.supervisor import LslProcesses
from tests.waiting import wait_until

processes = LslProcesses(LslSettings(enabled=True, config=sys.argv[1]))
processes.restart(lambda: None)
wait_until(lambda: processes.version)
print(processes._process.pid, flush=True)
signal.pause()
"""


@pytest.fixture
def processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[LslProcesses]:
    monkeypatch.setattr(supervisor, "_FIRST_RETRY_S", 0.05)
    processes = LslProcesses(LslSettings(enabled=True, config=str(lsl_config(tmp_path))))
    processes._retry_delay_s = 0.05
    yield processes
    processes.stop()


def nothing() -> None:
    """There are no streams to open again."""


def raise_too_many_files() -> None:
    raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))


def start(processes: LslProcesses, reopen: Callable[[], None] = nothing) -> int:
    """Start a process and wait until it is ready; return its number."""
    wait_until(lambda: processes.is_due, TIMEOUT_S)
    processes.restart(reopen)
    wait_until(lambda: not processes.problem, TIMEOUT_S)
    assert processes._process is not None
    return processes._process.pid


def test_a_process_loads_liblsl_and_ends_with_its_supervisor(processes: LslProcesses) -> None:
    assert "not started" in processes.problem
    number = start(processes)
    assert int(processes.version) >= 116
    assert not processes.is_due
    processes.stop()
    assert not Path(f"/proc/{number}").exists()
    assert not processes.is_due
    assert processes.problem == "LSL is closed; start the gateway again"
    assert not processes.send(Message(Kind.CLOSE, 1))


def test_a_process_that_ended_is_replaced_and_gets_the_streams_again(
    processes: LslProcesses, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    first = start(processes)
    os.kill(first, signal.SIGKILL)
    wait_until(lambda: processes.problem, TIMEOUT_S)
    assert processes.problem == "the process for LSL ended by SIGKILL; it is started again"
    reopened: list[bool] = []
    assert start(processes, lambda: reopened.append(True)) != first
    assert reopened == [True]
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert warnings == ["lsl: the process for LSL ended by SIGKILL; it is started again"]
    assert "streams are offered by liblsl" in caplog.records[-1].getMessage()


def test_the_signals_that_stop_a_gateway_do_not_end_the_process(processes: LslProcesses) -> None:
    number = start(processes)
    os.kill(number, signal.SIGTERM)
    os.kill(number, signal.SIGINT)
    processes.send(Message(Kind.OPEN, 1, b'[{"name": "lab_3d"}, []]'))  # which it reports, if it lives
    wait_until(lambda: processes.problem, TIMEOUT_S)
    assert processes.problem.startswith("liblsl cannot open the stream lab_3d: ")


@pytest.mark.parametrize("sends", [False, True], ids=["nothing sent", "a lot sent"])
def test_a_process_that_hangs_is_killed_and_replaced(
    processes: LslProcesses, monkeypatch: pytest.MonkeyPatch, sends: bool
) -> None:
    monkeypatch.setattr(supervisor, "SILENCE_S", 3.0)
    first = start(processes)
    os.kill(first, signal.SIGSTOP)
    large = Message(Kind.TEXTS, 1, bytes(1_000_000))
    sent = 0
    while sends and processes.send(large):
        sent += 1
        assert sent < 100
    wait_until(lambda: processes.problem, TIMEOUT_S)
    assert processes.problem in {
        "the process for LSL has not answered for 3 s; it is started again",
        "the process for LSL ended by SIGKILL; it is started again",
    }
    assert start(processes) != first


def test_a_process_that_hangs_ends_with_a_gateway_that_is_killed(tmp_path: Path) -> None:
    gateway = subprocess.Popen(
        [sys.executable, "-c", _GATEWAY, str(lsl_config(tmp_path))], stdout=subprocess.PIPE, text=True
    )
    assert gateway.stdout is not None
    with gateway.stdout as lines:
        number = int(next(lines))
    os.kill(number, signal.SIGSTOP)
    gateway.kill()
    gateway.wait()
    wait_until(lambda: not Path(f"/proc/{number}/exe").exists(), TIMEOUT_S)


def test_why_liblsl_cannot_be_loaded_is_said(
    processes: LslProcesses, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pylsl.py").write_text("raise ImportError('libc is too old')")
    monkeypatch.syspath_prepend(tmp_path)
    processes.restart(nothing)
    wait_until(lambda: "failed" in processes.problem, TIMEOUT_S)
    assert processes.problem == (
        "the process for LSL failed: ImportError: libc is too old; it is started again"
    )


def test_modules_in_the_working_directory_are_not_used(
    processes: LslProcesses, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pylsl.py").write_text("raise ImportError('this is a program of the user')")
    (tmp_path / "queue.py").write_text("raise ImportError('this too')")
    monkeypatch.chdir(tmp_path)
    start(processes)


def test_a_process_that_cannot_be_started_is_tried_again(
    processes: LslProcesses, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as without_descriptors:
        without_descriptors.setattr(socket, "socketpair", raise_too_many_files)
        processes.restart(nothing)
    assert processes.problem == (
        "the process for LSL cannot be started: Too many open files; it is started again"
    )
    start(processes)


def test_a_stream_that_cannot_open_is_reported_and_tried_again(processes: LslProcesses) -> None:
    start(processes)
    processes.send(Message(Kind.OPEN, 1, b'[{"name": "lab_3d"}, []]'))
    wait_until(lambda: processes.problem, TIMEOUT_S)
    assert processes.problem.startswith("liblsl cannot open the stream lab_3d: ")
    processes.send(Message(Kind.CLOSE, 1))
    wait_until(lambda: not processes.problem, TIMEOUT_S)


def test_a_missing_package_is_one_sentence_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *more: None if name == "pylsl" else find(name, *more)
    )
    with pytest.raises(ConfigError, match=r"'pylsl' is not installed.*pip install 'rtc3d-gateway\[lsl\]'"):
        LslOutput(LslSettings(enabled=True))


def test_a_configuration_of_liblsl_that_is_not_there_is_a_mistake() -> None:
    with pytest.raises(ConfigError, match=r"lsl\.config: /no/such/file cannot be read"):
        LslOutput(LslSettings(enabled=True, config="/no/such/file"))
