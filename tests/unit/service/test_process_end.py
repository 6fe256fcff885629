"""The end of the process, each time in a process of its own."""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

PROLOGUE = """
import atexit, logging, os, sys, threading, time
from gateway.service.process_end import StopDeadline, end_process
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


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", PROLOGUE + code], capture_output=True, text=True, check=False, timeout=60
    )


@contextmanager
def running(code: str) -> Iterator[subprocess.Popen[str]]:
    """Run code that prints a line when it is ready."""
    command = [sys.executable, "-c", PROLOGUE + code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline()
        yield process
        process.kill()


def test_the_end_has_the_status_and_writes_everything() -> None:
    ended = run("atexit.register(print, 'at exit')\nprint('printed', end=' ')\nend_process(3)")
    assert (ended.returncode, ended.stdout) == (3, "printed at exit\n")


def test_the_end_does_not_wait_for_threads() -> None:
    assert run("threading.Thread(target=time.sleep, args=(60,)).start()\nend_process(0)").returncode == 0


def test_a_reader_that_is_gone_is_no_error() -> None:
    code = "reading, writing = os.pipe()\nos.close(reading)\nsys.stdout = open(writing, 'w')\nprint('x')\n"
    ended = run(code + "end_process(0)")
    assert (ended.returncode, ended.stderr) == (0, "")


def test_a_full_device_is_an_error() -> None:
    ended = run("sys.stdout = open('/dev/full', 'w')\nprint('x')\nend_process(0)")
    assert (ended.returncode, ended.stderr) == (1, "cannot write the output: No space left on device\n")


def test_threads_in_calls_of_zenoh_do_not_abort_the_process() -> None:
    for _ in range(5):
        ended = run(CALLS_WITHOUT_END)
        assert (ended.returncode, ended.stderr) == (0, "")


def test_the_deadline_logs_what_is_not_finished() -> None:
    began_s = time.monotonic()
    ended = run("StopDeadline(lambda: ['one', 'two']).begin()\ntime.sleep(60)")
    assert ended.returncode == 0
    assert ended.stderr == (
        "the gateway ends at once, because it did not stop within 1.5 s; not finished: one, two\n"
    )
    assert 1.5 < time.monotonic() - began_s < 50


def test_a_second_request_ends_the_process_at_once() -> None:
    ended = run("deadline = StopDeadline(list)\ndeadline.begin()\ndeadline.begin()\ntime.sleep(60)")
    assert ended.returncode == 0
    assert ended.stderr == (
        "the gateway ends at once, because of a second signal; not finished: other tasks\n"
    )


def test_without_a_request_nothing_ends() -> None:
    assert run("StopDeadline(list)\ntime.sleep(2)\nend_process(5)").returncode == 5


def test_a_log_that_blocks_does_not_delay_the_deadline() -> None:
    code = """
class Blocked(logging.Handler):
    def emit(self, record):
        time.sleep(60)
logging.getLogger().handlers = [Blocked()]
deadline = StopDeadline(list)
import signal
signal.signal(signal.SIGTERM, lambda *_: deadline.begin())
print(flush=True)
time.sleep(60)
"""
    with running(code) as process:
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0
