"""The end of the process, each time in a process of its own."""

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.support.errors import names

PROLOGUE = """
import atexit, ctypes, logging, os, sys, threading, time
from gateway.runtime.process_end import Signals, end_process
logging.basicConfig(format="%(message)s")
"""

CALLS_WITHOUT_END = """
import json, zenoh
session = zenoh.open(zenoh.Config.from_json5(json.dumps(
    {"mode": "peer", "scouting": {"multicast": {"enabled": False}}, "listen": {"endpoints": []}}
)))
publisher = session.declare_publisher("a")
subscriber = session.declare_subscriber("a", lambda sample: None)
def put():
    while True:
        publisher.put(bytes(1000))
for _ in range(4):
    threading.Thread(target=put, daemon=True).start()
time.sleep(0.1)
end_process(0)
"""

CLOSED_PIPE = """
reading, writing = os.pipe()
os.close(reading)
sys.stdout = open(writing, "w")
print("x")
end_process(0)
"""


def run(code: str) -> tuple[int, str, str]:
    """Run code to its end; return its status, its output and its errors."""
    command = [sys.executable, "-c", PROLOGUE + code]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    return ended.returncode, ended.stdout, ended.stderr


@contextmanager
def running(code: str) -> Iterator[subprocess.Popen[str]]:
    """Run code that prints a line when it is ready."""
    command = [sys.executable, "-c", PROLOGUE + code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline()
        yield process
        process.kill()


@pytest.mark.parametrize(
    ("code", "ended"),
    [
        (
            "atexit.register(print, 'at exit')\nprint('printed', end=' ')\nend_process(3)",
            (3, "printed at exit\n", ""),
        ),
        ("threading.Thread(target=time.sleep, args=(60,)).start()\nend_process(0)", (0, "", "")),
        (
            CLOSED_PIPE,
            (0, "", ""),
        ),
        (
            "sys.stdout = open('/dev/full', 'w')\nprint('x')\nend_process(0)",
            (1, "", f"cannot write the output: {os.strerror(errno.ENOSPC)}\n"),
        ),
        (CALLS_WITHOUT_END, (0, "", "")),
    ],
    ids=[
        "the status, and everything is written",
        "threads are not waited for",
        "a reader that is gone is no error",
        "a full device is an error",
        "threads in calls of Zenoh do not abort the process",
    ],
)
def test_the_end_has_its_status_output_and_errors(code: str, ended: tuple[int, str, str]) -> None:
    for _ in range(5 if code is CALLS_WITHOUT_END else 1):
        assert run(code) == ended


# The main thread is in a call that never returns, not even for a signal: it locks a mutex twice.
BLOCKED = """
def say(word):
    print(word, flush=True)
Signals(lambda: say("stopping"), lambda: say("hung up"), lambda: ["one", "two"])
say("ready")
mutex = ctypes.create_string_buffer(64)
while True:
    ctypes.CDLL(None).pthread_mutex_lock(mutex)
"""


def ended(process: subprocess.Popen[str]) -> tuple[str, list[str]]:
    """Return the output, and the lines of the log, of a process that ends."""
    output, errors = process.communicate(timeout=30)
    return output, errors.splitlines()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_blocked_process_ends_at_the_deadline_and_logs_what_is_not_finished(number: int) -> None:
    with running(BLOCKED) as process:
        began_s = time.monotonic()
        process.send_signal(number)
        output, [line] = ended(process)
        assert output == "stopping\n"
        assert names(line, "1.5 s", "one, two")
        assert process.returncode == 0
        assert time.monotonic() - began_s > 1.4


def test_a_second_signal_ends_the_process_at_once() -> None:
    with running(BLOCKED) as process:
        process.send_signal(signal.SIGTERM)
        assert process.stdout is not None
        assert process.stdout.readline() == "stopping\n"
        process.send_signal(signal.SIGINT)
        _, [line] = ended(process)
        assert names(line, "second signal", "one, two")
        assert process.returncode == 0


def test_sighup_is_received_before_a_stop_and_does_not_end_it() -> None:
    with running(BLOCKED) as process:
        assert process.stdout is not None
        for _ in range(2):
            process.send_signal(signal.SIGHUP)
            assert process.stdout.readline() == "hung up\n"
        process.send_signal(signal.SIGTERM)
        assert process.stdout.readline() == "stopping\n"
        process.send_signal(signal.SIGHUP)
        _, [line] = ended(process)
        assert names(line, "1.5 s")
        assert process.returncode == 0


def test_a_stop_in_time_has_its_own_status() -> None:
    code = "stop = threading.Event()\nSignals(stop.set, list, list)\nprint(flush=True)\nstop.wait()\n"
    with running(code + "end_process(5)") as process:
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 5


@pytest.mark.parametrize("error", ["MemoryError", "RuntimeError"])
def test_a_process_that_can_neither_be_told_nor_start_a_thread_ends_nevertheless(error: str) -> None:
    """With an address space that was full, SIGTERM killed only the thread that receives signals."""
    code = f"""
def fail(*_):
    raise {error}
Signals(fail, fail, list)
threading.Thread.start = fail
print(flush=True)
time.sleep(60)
"""
    with running(code) as process:
        process.send_signal(signal.SIGHUP)
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0


def test_a_log_that_blocks_does_not_delay_the_deadline() -> None:
    code = """
class Blocked(logging.Handler):
    def emit(self, record):
        time.sleep(60)
logging.getLogger().handlers = [Blocked()]
Signals(lambda: None, lambda: None, list)
print(flush=True)
time.sleep(60)
"""
    with running(code) as process:
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0
