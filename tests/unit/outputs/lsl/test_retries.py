"""When the process for LSL is started again, without a process: sockets in its place, and a clock to set."""

import socket
from types import SimpleNamespace

import pytest

from gateway.outputs.lsl import supervisor
from gateway.outputs.lsl.settings import LslSettings
from gateway.outputs.lsl.supervisor import LslProcesses
from gateway.outputs.lsl.wire import Report
from tests.waiting import wait_until


class Ended:
    """A process that ends when the test closes its end of the socket."""

    def __init__(self) -> None:
        self.was_killed = False

    def kill(self) -> None:
        self.was_killed = True

    def wait(self, timeout: float | None = None) -> int:  # noqa: ARG002 - as of subprocess.Popen
        return 3


class Lab:
    """Processes whose time is ``now_s``."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        self.theirs: socket.socket
        self.changes: list[frozenset[int]] = []
        monkeypatch.setattr(supervisor, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        monkeypatch.setattr(supervisor, "_start_process", self._start)
        self.processes = LslProcesses(LslSettings(enabled=True), self._note)

    def _start(self, _settings: LslSettings) -> tuple[socket.socket, Ended]:
        ours, self.theirs = socket.socketpair()
        return ours, Ended()

    def _note(self) -> None:
        self.changes.append(self.processes.wanted)

    def live(self, seconds: float) -> None:
        """Start a process that ends after this time."""
        assert self.processes.is_due
        self.processes.restart(lambda: None)
        self.now_s += seconds
        self.theirs.close()
        wait_until(lambda: self.processes._socket is None and "status 3" in self.processes.problem)

    def report(self, report: Report) -> None:
        self.theirs.sendall(report.encode())
        wait_until(lambda: self.processes._report == report)

    def delay_s(self) -> float:
        """Return how long it takes until the next process is due, to a tenth of a second."""
        began_s = self.now_s
        while not self.processes.is_due:
            self.now_s += 0.1
        return round(self.now_s - began_s, 1)


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
    lab.processes.restart(lambda: None)
    assert not lab.processes.is_due  # there is one
    for wanted, failed in (((1,), ""), ((1,), "x"), ((1, 2), "x"), ((), "x"), ((3,), "")):
        lab.report(Report(ready="116", wanted=wanted, not_opened=failed))
    assert lab.changes == [{1}, {1, 2}, set(), {3}]
    lab.theirs.close()
    wait_until(lambda: lab.processes._socket is None)
    assert lab.processes.wanted == {3}
    lab.now_s += 60
    lab.processes.stop()
    assert lab.changes[-1] == set()
    assert not lab.processes.is_due
