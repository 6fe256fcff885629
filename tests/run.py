"""Run pytest in several workers, each in a network namespace of its own, and leave no process behind.

    python tests/run.py [--workers N] [--again] [ARGUMENT_OF_PYTEST ...]

With --again, up to MAX_AGAIN tests that failed are run once more, one at a time: CI shares its machine with
others. Tests that pass then are named at the end, because their causes must be found.

Ctrl-C or SIGTERM ends the run with pytest's summary. Whatever the tests have started and not ended is killed.

For the tests, the machine has just booted: what holds while its clocks are near zero holds later, too.
RTC3D_UPTIME_S sets another uptime.
"""

import argparse
import contextlib
import ctypes
import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import Final

import pytest

WORKERS_PER_CORE: Final = 3
"""Many tests wait for some of their time. With two per core, the cores were idle for a quarter of a run."""

WORKERS_S: Final = 1.0
"""When the workers are killed after Ctrl-C. By then, pytest no longer counts what they run as failed."""

UPTIME_S: Final = "5"
"""How long the machine seems to have been up when the workers start."""

SUMMARY_S: Final = 4.0
"""When pytest is killed after Ctrl-C, with or without its summary."""

MAX_AGAIN: Final = 5
"""How many tests may be run again; if more have failed, it was not by chance."""

_PR_SET_CHILD_SUBREAPER: Final = 36  # prctl(2): orphans of this process's descendants become its children
_WITH_NETNS: Final = Path(__file__).with_name("with-netns")


def main() -> int:
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)
    parser = argparse.ArgumentParser(allow_abbrev=False, add_help=False)
    parser.add_argument("--workers", type=int, default=WORKERS_PER_CORE * len(os.sched_getaffinity(0)))
    parser.add_argument("--again", action="store_true")
    options, rest = parser.parse_known_args()
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)  # `&` and nohup ignore them, and the tests would inherit that
    # Otherwise, each worker and each program that a test starts would compile all that it imports.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ.setdefault("RTC3D_UPTIME_S", UPTIME_S)
    return (_run_and_again if options.again else _run_pytest)(options.workers, rest)


def _run_and_again(num_workers: int, arguments: list[str]) -> int:
    with tempfile.TemporaryDirectory() as cache:
        arguments = ["-o", f"cache_dir={cache}", *arguments]
        status = _run_pytest(num_workers, arguments)
        if status != pytest.ExitCode.TESTS_FAILED:
            return status
        lastfailed = Path(cache, "v/cache/lastfailed")
        failed = [*json.loads(lastfailed.read_text())] if lastfailed.exists() else []
        if 0 < len(failed) <= MAX_AGAIN:
            status = _run_pytest(1, ["--last-failed", *arguments])
            if status == pytest.ExitCode.OK:
                print("FAILED ONCE, passed alone; find the cause:", *failed, sep="\n    ", flush=True)
        return status


def _run_pytest(num_workers: int, arguments: list[str]) -> int:
    workers = f"{num_workers}*popen//python={shlex.join([str(_WITH_NETNS), sys.executable])}"
    command = [sys.executable, "-m", "pytest", "--tx", workers, "--dist", "worksteal", "--durations", "10"]
    # In a session of its own, pytest receives one signal for each Ctrl-C: that of ``stop``.
    process = subprocess.Popen([*command, *arguments], start_new_session=True)

    stop_signals = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

    def stop(_signal: int, _frame: FrameType | None) -> None:
        for number in stop_signals:
            signal.signal(number, signal.SIG_IGN)
        os.kill(process.pid, signal.SIGINT)
        kill_later(WORKERS_S, lambda: set(_descendants(os.getpid())) - {process.pid})
        kill_later(SUMMARY_S, lambda: {process.pid})

    def kill_later(delay_s: float, processes: Callable[[], set[int]]) -> None:
        timer = threading.Timer(delay_s, lambda: _kill(processes()))
        timer.daemon = True
        timer.start()

    for number in stop_signals:
        signal.signal(number, stop)
    status = _reap_until(process.pid)
    while processes := list(_descendants(os.getpid())):
        _kill(processes)
        _reap_until(processes[0])
    return status if status >= 0 else 128 - status


def _reap_until(process: int) -> int:
    """Wait for a process, and for all that end before it: tests look whether a process has gone."""
    while True:
        ended, status = os.waitpid(-1, 0)
        if ended == process:
            return os.waitstatus_to_exitcode(status)


def _kill(processes: Iterable[int]) -> None:
    for process in processes:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)


def _descendants(process: int) -> Iterator[int]:
    """Yield the processes that ``process`` has started, those that these have started, and so on."""
    with contextlib.suppress(OSError):
        for children in Path(f"/proc/{process}/task").glob("*/children"):
            for child in map(int, children.read_text().split()):
                yield child
                yield from _descendants(child)


if __name__ == "__main__":
    sys.exit(main())
